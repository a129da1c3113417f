"""The term that pulls rendered depth to depth that the user has."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.train.rendered import Needs, Rendered, Turns

DEPTH = "depth"
"""Name of the term."""

KEPT = 2**29
"""Bytes of samples that are kept in memory; those of other views are read again at each use."""


@dataclass(frozen=True)
class DepthTerm:
    """Compares the rendered depth with `View.depth`: `gsplat_edu.ops.depth.depth_error`.

    Maps are compared by the relative difference, whose size is that of a sensor's error; points by 1 / z, whose error
    is that of triangulation. The depth of a lens is that of its projection (`Projection.along_ray`). Samples of
    a photo that keeps its lens stay at the photo's pixels while the lens is learned; those of a pinhole follow its
    focal lengths.

    Args:
        weight: Factor for maps, on the average of all steps.
        points_weight: Factor for sparse points.
        extent: Size of the scene, world units.
        turns: The steps that compare them.
    """

    weight: float
    points_weight: float
    extent: float
    turns: Turns
    _kept: dict[int, tuple[Tensor, ...]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def needs(self) -> Needs:
        """The depth, in its turns."""
        return Needs(depth=True, turns=self.turns)

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight every mean rho; 0 for a view without depth.

        Raises:
            ArgumentError: the depth was not rendered.
        """
        if not self.turns.due(rendered.iteration) or rendered.draw.view.depth is None:
            return rendered.output.image.new_zeros(())
        surface = rendered.surface
        if surface.depth is None:
            raise ArgumentError("depth: needs the depth, which was not rendered")
        rays, depths, weights, sparse = self._samples(rendered, surface.depth)
        own = rendered.draw.view.camera
        camera = rendered.camera if own.pinhole and rendered.camera is not None else own
        focal, middle = (rays.new_tensor(pair) for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy)))
        weight = (self.points_weight if bool(sparse) else self.weight) * self.turns.every
        rule = DepthRule(weight, extent=self.extent if bool(sparse) else None)
        pixels, wraps = rays * focal + middle, own.projection.wraps
        return depth_error(surface.depth, surface.alpha, pixels, depths, weights, rule, wraps)

    def _samples(self, rendered: Rendered, like: Tensor) -> tuple[Tensor, ...]:
        """Return rays, depths, weights and sparseness of the view's samples, from memory if there is room."""
        index, read = rendered.draw.index, rendered.draw.view.depth
        if index in self._kept:
            return self._kept[index]
        assert read is not None
        given = read()
        found = [torch.from_numpy(array).to(like) for array in (given.rays, given.depths, given.weights)]
        samples = (*found, torch.tensor(given.sparse))
        if sum(t.nbytes for kept in self._kept.values() for t in kept) + given.nbytes <= KEPT:
            self._kept[index] = samples
        return samples
