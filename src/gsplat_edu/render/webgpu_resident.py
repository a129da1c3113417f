"""A training that stays on the adapter of the backend webgpu: tensors become the engine's arrays, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.engine.resident import Resident, Result
from gsplat_edu.engine.room import kept_photos
from gsplat_edu.engine.step import NO_SHELL, Noise, Photo, StepNumbers
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import WORD, NoiseNumbers
from gsplat_edu.render import webgpu
from gsplat_edu.render.resident import RunRules, RunState, RunSums, RunTarget
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera


class WebgpuRun:
    """A training on the adapter; see `gsplat_edu.render.resident.ResidentRun`.

    Args:
        harmonics: K, per Gaussian besides the first.
        photo_room: Bytes of photos to keep there, at most `gsplat_edu.engine.resident.PHOTO_ROOM`, which None means.

    Raises:
        BackendUnavailableError: there is no adapter, or it does not start.
    """

    def __init__(self, harmonics: int, photo_room: int | None = None) -> None:
        self.resident = Resident(webgpu.device(), harmonics, kept_photos(photo_room))

    def load(self, state: RunState) -> None:
        """Begin with this state."""
        statistics = torch.stack([state.norm_sums, state.times_visible], dim=1)
        arrays = {"statistics": statistics.numpy()}
        for prefix, tensors in (("", state.gaussians), ("_first", state.first), ("_second", state.second)):
            arrays |= {f"core{prefix}": _core(tensors), f"rest{prefix}": _array(tensors["sh_rest"])}
        self.resident.load(arrays)

    def read(self) -> RunState:
        """Wait for all steps, and return the state."""
        found = self.resident.read()
        gaussians, first, second = (
            _tensors(found[f"core{suffix}"], found[f"rest{suffix}"]) for suffix in ("", "_first", "_second")
        )
        norm_sums, times_visible = torch.from_numpy(found["statistics"]).unbind(dim=1)
        return RunState(gaussians, first, second, norm_sums.contiguous(), times_visible.contiguous())

    def image(self) -> Tensor:
        """Wait for all steps, and return the last one's image, (H, W, 3)."""
        return torch.from_numpy(self.resident.image())

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
        result = self.resident.step(
            webgpu.engine_view(camera, settings, settings.background, degree),
            target.index,
            lambda: Photo.packed(target.image.numpy(), mask),
            target.constant,
            numbers,
        )
        return lambda: _sums(result, numbers, count)

    def add_noise(self, numbers: NoiseNumbers, rules: RunRules) -> None:
        """Move the means at random after the last step."""
        seed = numbers.seed & WORD, numbers.seed >> 32
        self.resident.add_noise(
            Noise(seed, numbers.amount, numbers.sharpness, numbers.threshold, _shell(rules))
        )


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
