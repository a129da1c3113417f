"""The learned Gaussians: raw parameters, and the activations that map them to rendered quantities.

Chapters: 07_a_trained_scene, 13_back_to_the_parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.derivatives import refuse_halves
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.pictures import scene_shower
from gsplat_edu.base.validation import Shape, check_shape, first_index, quoted


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians:
    """N Gaussians as raw parameters, which gradient descent may change freely.

    Args:
        means: (N, 3) centres, world units.
        quats: (N, 4) quaternions (w, x, y, z), normalised on use.
        log_scales: (N, 3) natural logarithm of the standard deviations in world units.
        sh0: (N, 1, 3) spherical harmonics coefficient of degree 0.
        sh_rest: (N, K, 3) coefficients of degree 1 and up: K = 0, 3, 8 or 15.
        logit_opacities: (N,) logit of the opacities.

    Raises:
        ShapeError: a shape differs, or the parameters have different N.
        ArgumentError: a parameter is not a float32 or float64 tensor of the same dtype and device as the means.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    sh0: Float[Tensor, "N 1 3"]
    sh_rest: Float[Tensor, "N K 3"]
    logit_opacities: Float[Tensor, " N"]

    def __post_init__(self) -> None:
        """Check that shapes, dtypes and devices agree."""
        given: dict[str, object] = dict(self.tensors())
        for name, tensor in given.items():
            _check_kind(name, tensor, self.means)
        sizes: dict[str, int] = {}
        for name, shape in {
            "means": ("N", 3),
            "quats": ("N", 4),
            "log_scales": ("N", 3),
            "sh0": ("N", 1, 3),
            "sh_rest": ("N", "K", 3),
            "logit_opacities": ("N",),
        }.items():
            check_shape(name, getattr(self, name).shape, shape, sizes)
        if sizes["K"] not in (0, 3, 8, 15):
            raise ShapeError(
                f"sh_rest: holds {sizes['K']} coefficients per channel, but degrees 0-3 have 0, 3, 8, 15"
            )

    @classmethod
    def from_activated(
        cls,
        means: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
        scales: Float[Tensor, "N 3"],
        opacities: Float[Tensor, " N"],
        colors: Float[Tensor, "N 3"] | Float[Tensor, "N K 3"],
    ) -> Gaussians:
        """Make Gaussians of the quantities that are rendered.

        log_scales = log(scales),  logit_opacities = log(o / (1 - o)),  sh0 = (colour - 0.5) / C0

        Args:
            means: (N, 3) centres, world units.
            quats: (N, 4) quaternions (w, x, y, z) of nonzero length.
            scales: (N, 3) standard deviations, world units, above 0.
            opacities: (N,) between 0 and 1, both excluded.
            colors: (N, 3) colours from 0 to 1, or (N, K, 3) harmonics, degree 0 first: K = 1, 4, 9 or 16.

        Raises:
            ShapeError: a shape differs, or the arguments have different N.
            ArgumentError: an entry is NaN, infinite or out of range, a quaternion has zero length, or an argument is
                not a float32 or float64 tensor of the same dtype and device as the means.

        Differentiable in: every argument.
        """
        sizes: dict[str, int] = {}
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
        check_tensor("colors", colors, ("...",), {})
        flat = colors.ndim == 2
        shapes: tuple[Shape, ...] = (
            ("N", 3),
            ("N", 4),
            ("N", 3),
            ("N",),
            ("N", 3) if flat else ("N", "K", 3),
        )
        for (name, tensor), shape in zip(given.items(), shapes, strict=True):
            check_tensor(name, tensor, shape, sizes)
            _check_kind(name, tensor, means)
        if not flat and sizes["K"] not in (1, 4, 9, 16):
            raise ShapeError(
                f"colors: holds {sizes['K']} coefficients per channel, but degrees 0-3 have 1, 4, 9, 16"
            )
        check_lengths(quats)
        _check_entries("scales", scales, scales > 0, "above 0")
        _check_entries("opacities", opacities, (opacities > 0) & (opacities < 1), "between 0 and 1")
        if flat:
            _check_entries("colors", colors, (colors >= 0) & (colors <= 1), "from 0 to 1")
            colors = (colors[:, None] - SH_OFFSET) / C0
        logits = torch.log(opacities) - torch.log1p(-opacities)
        return cls(means, quats, torch.log(scales), colors[:, :1], colors[:, 1:], logits)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Tensor]) -> Gaussians:
        """Make the Gaussians whose `state_dict` this is; their number is that of the state.

        Args:
            state: The raw parameters by name.

        Raises:
            ShapeError, ArgumentError: a parameter is missing, unknown, or as for the constructor.
        """
        names = [field.name for field in fields(cls)]
        if differing := sorted(set(names) ^ set(state)):
            problem = "is missing" if differing[0] in names else "is unknown"
            raise ArgumentError(f"state: {quoted(differing[0])} {problem}")
        return cls(**state)

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.means.shape[0]

    def __repr__(self) -> str:
        """Return one line: the number, the degree of the harmonics, dtype and device."""
        dtype = str(self.means.dtype).removeprefix("torch.")
        return f"Gaussians({len(self):,}, SH degree {self.sh_degree}, {dtype} on {self.means.device})"

    def _repr_html_(self) -> str:
        return str(scene_shower().scene_html(self))

    def view(self, height: int = 480) -> object:
        """Return the viewer's page of these Gaussians, which a notebook shows in a frame, to turn and to walk.

        Args:
            height: Height of the frame, px.

        Raises:
            ArgumentError: the height is not a whole number of at least 100, or a parameter is NaN or infinite.
        """
        page: object = scene_shower().scene_page(self, height)
        return page

    def __getitem__(self, index: Any) -> Gaussians:  # noqa: ANN401
        """Return some of the Gaussians.

        Args:
            index: (N,) mask, (M,) indices or a slice; a tensor, an array or a list.

        Raises:
            ArgumentError: the index is of another kind, a mask has another length, or an index is out of range.
        """
        if not isinstance(index, slice):
            index = self._rows(index)
        return self.map(lambda tensor: tensor[index])

    def _rows(self, index: Any) -> Tensor:  # noqa: ANN401
        """Check a mask or indices, and return the indices on the Gaussians' device."""
        try:
            rows = torch.as_tensor(index, device=self.means.device)
        except (TypeError, ValueError, RuntimeError):
            raise ArgumentError(
                f"index: is {quoted(index)}, but has to be a mask, indices or a slice"
            ) from None
        if rows.ndim != 1 or (rows.numel() and (rows.is_floating_point() or rows.is_complex())):
            raise ArgumentError(
                f"index: has dtype {rows.dtype} and shape {tuple(rows.shape)}, but has to be a mask, indices or a slice"
            )
        if rows.dtype == torch.bool:
            if len(rows) != len(self):
                raise ArgumentError(f"index: is a mask of {len(rows)}, but there are {len(self)} Gaussians")
            return rows.nonzero()[:, 0]
        rows = rows.long()
        if len(rows) and not (-len(self) <= int(rows.min()) and int(rows.max()) < len(self)):
            raise ArgumentError(f"index: names a Gaussian beyond the {len(self)} there are")
        return rows

    @property
    def sh_degree(self) -> int:
        """Highest stored SH degree."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.sh_rest.shape[1]]

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations exp(log_scales), (N, 3), world units."""
        return torch.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """Opacities sigmoid(logit_opacities) in (0, 1), (N,)."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """All coefficients, degree 0 first, (N, K, 3): K = 1, 4, 9 or 16."""
        return torch.cat([self.sh0, self.sh_rest], dim=1)

    def tensors(self) -> dict[str, Tensor]:
        """Return the raw parameters by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def parameters(self) -> Iterator[Tensor]:
        """Yield the raw parameters, in the order of the fields."""
        return iter(self.tensors().values())

    def parameter_groups(self, rates: Mapping[str, float]) -> list[dict[str, Any]]:
        """Return a group for each named parameter, as the optimisers of `torch.optim` take them.

        Args:
            rates: Learning rates by the name of the raw parameter; a parameter without a rate is in no group.

        Returns:
            Groups with the keys params, lr and name.

        Raises:
            ArgumentError: a name is not that of a raw parameter.
        """
        tensors = self.tensors()
        if unknown := sorted(set(rates) - set(tensors)):
            raise ArgumentError(f"rates: {quoted(unknown[0])} is not one of {', '.join(tensors)}")
        return [{"params": [tensors[name]], "lr": rate, "name": name} for name, rate in rates.items()]

    def state_dict(self) -> dict[str, Tensor]:
        """Return the raw parameters by name, without gradients; they share memory with these Gaussians."""
        return {name: tensor.detach() for name, tensor in self.tensors().items()}

    def check_finite(self) -> None:
        """Check that no raw parameter is NaN or infinite.

        Raises:
            ArgumentError: one is NaN or infinite; the message names the parameter and the entry.
        """
        for name, tensor in self.tensors().items():
            check_tensor(name, tensor, ("...",), {})

    def finite_rows(self) -> Bool[Tensor, " N"]:
        """Return for each Gaussian whether all its raw parameters are finite."""
        finite = [torch.isfinite(t.detach()).flatten(1).all(dim=1) for t in (self.sh0, self.sh_rest)]
        flat = (self.means, self.quats, self.log_scales, self.logit_opacities[:, None])
        return torch.stack([*finite, *(torch.isfinite(t.detach()).all(dim=1) for t in flat)]).all(dim=0)

    def map(self, change: Callable[[Tensor], Tensor]) -> Gaussians:
        """Apply a function to every raw parameter and return the new Gaussians."""
        return Gaussians(**{name: change(tensor) for name, tensor in self.tensors().items()})

    def to(self, device: torch.device) -> Gaussians:
        """Return the Gaussians with their parameters on a device."""
        return self.map(lambda tensor: tensor.to(device))

    def trainable(self) -> Gaussians:
        """Return a contiguous copy whose parameters are leaves that accumulate gradients."""
        dense = torch.contiguous_format
        return self.map(lambda tensor: tensor.detach().clone(memory_format=dense).requires_grad_())

    @staticmethod
    def concatenated(parts: Sequence[Gaussians]) -> Gaussians:
        """Join Gaussians in the given order.

        Raises:
            ArgumentError: there are none, or two differ in SH degree, dtype or device.
        """
        if not parts:
            raise ArgumentError("parts: is empty; give at least one set of Gaussians")
        for number, part in enumerate(parts):
            _check_kind(f"parts[{number}]", part.means, parts[0].means, "parts[0] is")
            if part.sh_degree != parts[0].sh_degree:
                degrees = f"{part.sh_degree}, but parts[0] has {parts[0].sh_degree}"
                raise ArgumentError(f"parts[{number}]: has SH degree {degrees}")
        tensors = [part.tensors() for part in parts]
        return Gaussians(**{name: torch.cat([each[name] for each in tensors]) for name in tensors[0]})


def quat_to_R_t(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Convert N quaternions to rotation matrices, differentiably.

    Args:
        quats: (N, 4) quaternions (w, x, y, z) of nonzero length.

    Returns:
        (N, 3, 3) rotations.

    Raises:
        ShapeError: not of shape (N, 4).
        ArgumentError: a quaternion has zero length, or an entry is NaN or infinite.

    Differentiable in: quats.
    """
    check_tensor("quats", quats, ("N", 4), {})
    check_lengths(quats)
    return unchecked_rotations(quats)


def check_lengths(quats: Float[Tensor, "... 4"]) -> None:
    """Check that no quaternion has zero length.

    Raises:
        ArgumentError: one has.
    """
    if int(torch.count_nonzero(quats.detach())) == quats.numel():
        return  # the usual case, much faster than what follows
    zero = (quats.detach() == 0).all(dim=-1)
    if bool(zero.any()):
        raise ArgumentError(f"quats{first_index(zero.numpy(force=True))}: has zero length")


def unchecked_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Convert quaternions to rotation matrices like `quat_to_R_t`, without checks: NaN for zero length.

    Args:
        quats: (N, 4) quaternions (w, x, y, z).

    Returns:
        (N, 3, 3) rotations.

    Differentiable in: quats.
    """
    # Dividing by the largest entry first keeps the norm from overflowing or underflowing. Autograd may treat it as
    # constant: a rotation does not depend on the quaternion's length.
    scaled = quats / quats.detach().abs().amax(dim=-1, keepdim=True)
    w, x, y, z = (scaled / scaled.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def cov3d_t(log_scales: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Build N covariances from raw parameters, differentiably.

    Sigma = (R S)(R S)',  S = diag(exp(log_scales))

    Args:
        log_scales: (N, 3) natural logarithm of the standard deviations in world units.
        quats: (N, 4) quaternions (w, x, y, z) of nonzero length.

    Returns:
        (N, 3, 3) covariances, world units squared.

    Raises:
        ShapeError: a shape differs, or the two arguments have different N.
        ArgumentError: a quaternion has zero length, or an entry is NaN or infinite.

    Differentiable in: log_scales, quats.
    """
    sizes: dict[str, int] = {}
    check_tensor("log_scales", log_scales, ("N", 3), sizes)
    check_tensor("quats", quats, ("N", 4), sizes)
    RS = quat_to_R_t(quats) * torch.exp(log_scales)[:, None, :]
    return RS @ RS.mT


def _check_kind(name: str, value: object, means: object, wanted: str = "means are") -> None:
    """Check that a value is a float32 or float64 tensor of the dtype and device of other Gaussians' means."""
    if not (isinstance(value, Tensor) and value.is_floating_point()):
        kind = value.dtype if isinstance(value, Tensor) else f"of type {type(value).__name__}"
        raise ArgumentError(f"{name}: is {kind}, but has to be a float tensor")
    refuse_halves(name, value)
    if isinstance(means, Tensor) and (value.dtype, value.device) != (means.dtype, means.device):
        kind = f"{means.dtype} on {means.device}"
        raise ArgumentError(f"{name}: is {value.dtype} on {value.device}, but {wanted} {kind}")


def _check_entries(name: str, value: Tensor, valid: Tensor, wanted: str) -> None:
    """Check that every entry is in its range, which `wanted` describes."""
    if not bool(valid.all()):
        wrong = float(value.detach()[~valid][0])
        where = first_index((~valid).numpy(force=True))
        raise ArgumentError(f"{name}{where}: is {wrong:g}, but has to be {wanted}")


def check_tensor(name: str, value: Tensor, shape: Shape, sizes: dict[str, int]) -> None:
    """Validate a tensor argument.

    Raises:
        ShapeError: the shape differs; see `gsplat_edu.base.validation.check_shape`.
        ArgumentError: it is not a tensor of real numbers, or an entry is NaN or infinite.
    """
    if not isinstance(value, Tensor):
        raise ArgumentError(f"{name}: is of type {type(value).__name__}, but has to be a tensor")
    if value.is_complex() or value.is_meta:
        kind = "complex" if value.is_complex() else "without data"
        raise ArgumentError(f"{name}: is {kind}, but has to hold real numbers")
    check_shape(name, value.shape, shape, sizes)
    if not is_finite(value):
        raise ArgumentError(
            f"{name}{first_index((~torch.isfinite(value)).numpy(force=True))}: is NaN or infinite"
        )


def is_finite(value: Tensor) -> bool:
    """Return whether all entries are finite, without a tensor of answers: a scene may fill half the memory."""
    if not value.numel() or not value.is_floating_point():
        return True
    low, high = value.detach().aminmax()  # NaN if there is one
    return bool(torch.isfinite(low) & torch.isfinite(high))
