"""Photos of a painted ball from its formula."""

import math

import numpy as np

from gsplat_edu import Camera

WAVES = np.random.default_rng(5).normal(size=(30, 3)) * 20.0
PHASES = np.random.default_rng(6).uniform(0, 2 * np.pi, 30)


def photo_of_ball(
    camera: Camera, texture: float = 25.0, shiny: float = 0.0, radius: float = 1.0
) -> np.ndarray:
    """Return a photo of a ball before a grey room by ray and sphere, without any mesh or splat.

    Its paint is a sum of waves through space; what is shiny moves with the eye, as a reflection does.
    """
    rays = camera.rays()
    a, b = np.square(rays).sum(axis=-1), (rays * camera.eye).sum(axis=-1)
    under = b * b - a * (camera.eye @ camera.eye - radius**2)
    hit = np.isfinite(a) & (under > 0)
    z = np.where(hit, -b - np.sqrt(np.maximum(under, 0.0)), 0.0) / np.where(hit, a, 1.0)
    place = camera.eye + z[..., None] * np.where(hit[..., None], rays, 0.0)
    mirrored = place - shiny * (camera.eye - place)
    paint = np.sin(mirrored @ WAVES.T + PHASES).sum(axis=-1) / math.sqrt(15.0)
    grey = np.where(hit & (z > 0), 128 + texture * paint, 90.0)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
