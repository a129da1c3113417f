"""The part that learns a surface, for meshes: the setting `surface`."""

from __future__ import annotations

from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.parts.surface.patches import PATCHES, Neighbourhood, PatchTerm
from gsplat_edu.parts.surface.terms import FLAT, NORMAL, FlatTerm, NormalTerm
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup
from gsplat_edu.train.rendered import Turns


class SurfacePart(Part):
    """Makes normals and neighbouring photos agree with the depth, and Gaussians flat."""

    off_device = ("surface",)

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the terms of a surface.

        weight_n mean a (a - N . m) + weight_f mean(smallest scale) / extent + weight_c mean min(1 - ncc, most)

        Raises:
            ArgumentError: a view is orthographic.
        """
        if not settings.surface:
            return None
        if flat := next((v for v in setup.views if v.camera.projection.kind == "orthographic"), None):
            raise ArgumentError(
                f"surface: needs rays that meet in the camera, and {flat.name or 'a photo'} is orthographic; "
                "leave it out, or train without --surface"
            )
        turns = Turns(settings.surface_start, settings.surface_every, settings.batch)
        terms: dict[str, Any] = {
            NORMAL: NormalTerm(settings.normal_weight, turns),
            FLAT: FlatTerm(settings.flat_weight, setup.extent, turns, setup.shell),
        }
        if settings.patch_weight > 0:
            around = Neighbourhood(setup.views, setup.view_model, setup.extent)
            terms[PATCHES] = PatchTerm(settings.patch_weight, turns, around, settings.seed)
        return Begun(terms)


SURFACE = SurfacePart()
