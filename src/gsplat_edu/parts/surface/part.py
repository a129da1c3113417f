"""The part that learns a surface, for meshes: the setting `surface`."""

from __future__ import annotations

import math
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.lenses import RAY_ROOM
from gsplat_edu.parts.surface.patches import PATCHES, PHOTO_ROOM, Neighbourhood, PatchTerm
from gsplat_edu.parts.surface.terms import FLAT, NORMAL, FlatTerm, NormalTerm
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Cost, Setup
from gsplat_edu.train.rendered import Turns

TERMS_TIME = 3.0
"""Further time of a step that learns from normals and flatness, in times of a plain one
("Surfaces" in the earlier results that benchmarks/RESULTS.md names)."""

RAY_BYTES = 12
"""Bytes of a pixel's ray in float32."""

GREY_BYTES = 2
"""Bytes per pixel of a photo without colours, with the mask of its pixels that count."""


class SurfacePart(Part):
    """Makes normals and neighbouring photos agree with the depth, and Gaussians flat."""

    off_device = untimed = ("surface",)

    def cost(self, settings: TrainConfig, asked: str | None, capture: Any) -> Cost | None:  # noqa: ANN401
        """Return the time of the terms, and the room for the rays of lenses and for photos without colours."""
        if not settings.surface:
            return None
        kept = min(RAY_ROOM, RAY_BYTES * math.ceil(capture.lens_pixels))
        if settings.patch_weight > 0:
            kept += min(PHOTO_ROOM, GREY_BYTES * math.ceil(capture.pixels) * capture.train)
        return Cost(TERMS_TIME / settings.surface_every, settings.surface_start, kept)

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
                "leave it out, or train without `surface`"
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
