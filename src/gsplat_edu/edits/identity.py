"""The identity of the scene that an edits file was made for."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

import torch
from msgspec import Meta

from gsplat_edu.base.records import Record
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.frame import FARTHEST_ORIGIN

ORDER = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
"""Parameters in the order in which they are hashed."""

MOST_SPLATS = 1 << 32

Coordinate = Annotated[float, Meta(ge=-FARTHEST_ORIGIN, le=FARTHEST_ORIGIN)]


class Identity(Record, frozen=True):
    """The facts that identify a scene.

    Args:
        count: Number of splats.
        sha256: Digest of its parameters; see `identity_of`.
        origin: That of the scene.
    """

    count: Annotated[int, Meta(ge=0, le=MOST_SPLATS)]
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z(?#64 digits of 0-9 and a-f)")]
    origin: tuple[Coordinate, Coordinate, Coordinate]

    def document(self) -> dict[str, Any]:
        """Return the entry "scene" of an edits file."""
        return {"count": self.count, "sha256": self.sha256, "origin": list(self.origin)}

    def difference(self, other: Identity) -> str | None:
        """Return in a few words how another scene differs from this one; None if it does not."""
        if self.count != other.count:
            return f"of {self.count:,} splats, this one has {other.count:,}"
        if self.origin != other.origin:
            return f"with the origin {list(self.origin)}, this one has {list(other.origin)}"
        if self.sha256 != other.sha256:
            return f"of as many splats, with other values: SHA-256 {self.sha256[:8]}, not {other.sha256[:8]}"
        return None


def identity_of(scene: Scene) -> Identity:
    """Return the identity of a scene: SHA-256 over its raw parameters as little-endian float32, one after the other.

    Args:
        scene: The scene as opened.
    """
    digest = hashlib.sha256()
    for name in ORDER:
        values = scene.gaussians.tensors()[name].detach().to(torch.float32).cpu().contiguous().numpy()
        digest.update(values.astype("<f4", copy=False).tobytes())
    return Identity(len(scene.gaussians), digest.hexdigest(), scene.origin)
