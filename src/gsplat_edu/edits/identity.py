"""The identity of the scene that an edits file was made for."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.json_fields import as_json, check_keys, checked_object, checked_whole, numbers_within
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.frame import FARTHEST_ORIGIN, Vector

ORDER = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
"""Parameters in the order in which they are hashed."""

MOST_SPLATS = 1 << 32


@dataclass(frozen=True)
class Identity:
    """The facts that identify a scene.

    Args:
        count: Number of splats.
        sha256: Digest of its parameters; see `identity_of`.
        origin: That of the scene.
    """

    count: int
    sha256: str
    origin: Vector

    def document(self) -> dict[str, Any]:
        """Return the entry "scene" of an edits file."""
        return {"count": self.count, "sha256": self.sha256, "origin": list(self.origin)}

    @classmethod
    def of_document(cls, where: str, value: object) -> Identity:
        """Return the identity that an edits file states.

        Raises:
            ArgumentError: a key is missing or unknown, or a value is invalid.
        """
        entry = checked_object(where, value)
        check_keys(f"{where}: ", entry, ("count", "sha256", "origin"))
        digest = entry["sha256"]
        if not isinstance(digest, str) or len(digest) != 64 or set(digest) - set("0123456789abcdef"):
            raise ArgumentError(f"{where}.sha256: is {as_json(digest)}, but has to be 64 hexadecimal digits")
        x, y, z = numbers_within(f"{where}.origin", entry["origin"], 3, FARTHEST_ORIGIN)
        return cls(checked_whole(f"{where}.count", entry["count"], 0, MOST_SPLATS), digest, (x, y, z))

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
