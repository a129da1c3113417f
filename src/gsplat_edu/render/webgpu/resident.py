"""A training that stays on the adapter of the backend webgpu: tensors become the engine's arrays, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.engine.failures import DeviceLostError
from gsplat_edu.engine.resident import Resident, Result
from gsplat_edu.engine.room import REPEATED_PHOTOS, kept_photos
from gsplat_edu.engine.step import NO_SHELL, Noise, PackedPhoto, StepNumbers
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import WORD, NoiseNumbers
from gsplat_edu.render.resident import RunRules, RunState, RunSums, RunTarget
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.webgpu import render as webgpu
from gsplat_edu.scene.camera import Camera

_Found = TypeVar("_Found")

MOST_STEPS = 500
"""Steps that are kept to be taken again. Beyond, or beyond `REPEATED_PHOTOS`, the state is read from the device."""


class WebgpuRun:
    """A training on the adapter; see `gsplat_edu.render.resident.ResidentRun`.

    It keeps what it has done since the last time that the host had the state. If the device is lost, it does the same
    again on a new one, which gives the same bits.

    Args:
        harmonics: K, per Gaussian besides the first.
        photo_room: Bytes of photos to keep there, at most `gsplat_edu.engine.resident.PHOTO_ROOM`, which None means.

    Raises:
        BackendUnavailableError: there is no adapter, or it does not start.

    Attributes:
        resident: What is on the device.
        repeatable: What was done since the host had the state, to be done again on another device.
    """

    def __init__(self, harmonics: int, photo_room: int | None = None) -> None:
        self._photo_room = kept_photos(photo_room)
        self.resident = Resident(webgpu.device(), harmonics, self._photo_room)
        self._start: RunState | None = None
        self.repeatable: list[Callable[[], None]] = []
        self._photos: dict[int, int] = {}
        self._image: Tensor | None = None
        self._losses = 0

    def load(self, state: RunState) -> None:
        """Begin with this state."""
        self._on_a_device(lambda: self.resident.load(_arrays(state)))
        self._begin_from(state)
        self._image = None

    def read(self) -> RunState:
        """Wait for all steps, and return the state."""
        found = self._on_a_device(lambda: self.resident.read())  # noqa: PLW0108  it may be another one
        if self._image is None and self.repeatable:
            self._image = self.image()
        gaussians, first, second = (
            _tensors(found[f"core{suffix}"], found[f"rest{suffix}"]) for suffix in ("", "_first", "_second")
        )
        norm_sums, times_visible = torch.from_numpy(found["statistics"]).unbind(dim=1)
        state = RunState(gaussians, first, second, norm_sums.contiguous(), times_visible.contiguous())
        self._begin_from(state)
        return state

    def image(self) -> Tensor:
        """Wait for all steps, and return the last one's image, (H, W, 3)."""
        if self._image is None:
            self._image = torch.from_numpy(self._on_a_device(lambda: self.resident.image()))  # noqa: PLW0108
        return self._image

    def step(
        self,
        camera: Camera,
        settings: RenderSettings,
        target: RunTarget,
        rates: Mapping[str, AdamNumbers],
        rules: RunRules,
    ) -> Callable[[], RunSums]:
        """Take a step, without waiting for it; what it returns waits."""
        count = self.resident.count
        numbers = StepNumbers(
            dict(rates),
            rules.ssim_weight,
            rules.opacity_weight,
            math.ceil(rules.least_share * count),  # fewer than this are fewer than the share
            rules.scale_weight,
            _shell(rules),
            rules.collects,
        )
        mask = None if target.mask is None else target.mask.numpy()
        degree = min(settings.sh_degree, math.isqrt(self.resident.harmonics + 1) - 1)
        view = webgpu.engine_view(camera, settings, settings.background, degree)
        result: Result

        def step() -> None:
            nonlocal result
            result = self.resident.step(
                view,
                target.index,
                lambda: PackedPhoto.packed(target.image.numpy(), mask),
                target.constant,
                numbers,
            )

        self._do(step)
        self._image = None
        self._photos[id(target.image)] = target.image.nbytes
        if len(self.repeatable) >= MOST_STEPS or sum(self._photos.values()) > REPEATED_PHOTOS:
            self.read()
        return lambda: self._on_a_device(lambda: _sums(result, numbers, count))

    def add_noise(self, numbers: NoiseNumbers, rules: RunRules) -> None:
        """Move the means at random after the last step."""
        seed = numbers.seed & WORD, numbers.seed >> 32
        noise = Noise(seed, numbers.amount, numbers.sharpness, numbers.threshold, _shell(rules))
        self._do(lambda: self.resident.add_noise(noise))

    def _begin_from(self, state: RunState) -> None:
        self._start, self.repeatable, self._photos, self._losses = state, [], {}, 0

    def _do(self, action: Callable[[], None]) -> None:
        """Do something that changes the state, and keep it to be done again."""
        self._on_a_device(action)
        self.repeatable.append(action)

    def _on_a_device(self, action: Callable[[], _Found]) -> _Found:
        """Return what a function returns; if the device is lost meanwhile, do everything again on a new one."""
        lost: DeviceLostError | None = None
        while True:
            used = self.resident.device
            try:
                if lost is not None:
                    self._losses += 1
                    what = f"{len(self.repeatable)} steps and what followed them are done again"
                    webgpu.replace_device(used, self._losses, what, lost)
                    self.resident = Resident(webgpu.device(), self.resident.harmonics, self._photo_room)
                    lost = None
                    if self._start is not None:
                        self.resident.load(_arrays(self._start))
                    for done in self.repeatable:
                        done()
                return action()
            except DeviceLostError as error:
                if lost is not None:
                    raise
                lost = error


def _arrays(state: RunState) -> dict[str, np.ndarray]:
    """Return a state as the engine takes it."""
    statistics = torch.stack([state.norm_sums, state.times_visible], dim=1)
    arrays = {"statistics": statistics.numpy()}
    for prefix, tensors in (("", state.gaussians), ("_first", state.first), ("_second", state.second)):
        arrays |= {f"core{prefix}": _core(tensors), f"rest{prefix}": _array(tensors["sh_rest"])}
    return arrays


def _sums(result: Result, numbers: StepNumbers, count: int) -> RunSums:
    sums, k = result.sums, numbers.ssim_weight
    averaged = sums.visible if sums.visible < numbers.few_visible else count
    return RunSums(
        (1.0 - k) * sums.l1 + k * sums.dissimilarity,
        numbers.opacity_weight * sums.opacity / max(averaged, 1),
        numbers.scale_weight * sums.scale / max(3 * count, 1),
        sums.pairs,
    )


def _shell(rules: RunRules) -> tuple[float, float, float, float]:
    if rules.shell is None:
        return NO_SHELL
    *centre, radius = rules.shell
    return centre[0], centre[1], centre[2], (radius / 2) ** 2


def _core(tensors: Mapping[str, Tensor]) -> np.ndarray:
    columns = [_array(tensors[name]).reshape(-1, width) for name, width in webgpu.CORE.items()]
    return np.concatenate(columns, axis=1)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy())


def _tensors(core: np.ndarray, rest: np.ndarray) -> dict[str, Tensor]:
    """Return raw parameters, or their moments, by name, in the order of the fields of `Gaussians`."""
    columns = dict(
        zip(webgpu.CORE, np.split(core, np.cumsum(list(webgpu.CORE.values()))[:-1], axis=1), strict=True)
    )
    columns["sh0"] = columns["sh0"].reshape(-1, 1, 3)
    columns["logit_opacities"] = columns["logit_opacities"].reshape(-1)
    names = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
    arrays = {name: rest if name == "sh_rest" else columns[name] for name in names}
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
