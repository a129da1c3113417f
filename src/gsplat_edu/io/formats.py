"""The registry of all scene formats, by file suffix."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from gsplat_edu.base.constants import POINT_SUFFIXES, RUN_CONFIG, SH_MAX_DEGREE
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.plugins import plugins
from gsplat_edu.base.validation import of_type
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.gaussians import Gaussians, is_finite


@dataclass(frozen=True)
class Format:
    """A scene format.

    Args:
        suffix: Suffix of its files, in lower case; for a folder, the whole name of the file that represents it.
        module: Module with `read(path) -> Scene` and `write(path, scene)`, as far as it can; it is imported when it is
            needed.
        name: Its common name.
        sh_degree: Highest SH degree that it stores.
        metadata: Whether it can store the scene's origin, up direction, unit and antialiasing.
    """

    suffix: str
    module: str
    name: str
    sh_degree: int = SH_MAX_DEGREE
    metadata: bool = True

    def read(self, path: Path) -> Scene:
        """Read a file of the format; see `read_scene`."""
        scene: Scene = importlib.import_module(self.module).read(path)
        return scene

    def write(self, path: Path, scene: Scene) -> None:
        """Write a file of the format; see `write_scene`."""
        importlib.import_module(self.module).write(path, scene)


FORMATS: tuple[Format, ...] = (
    Format(".compressed.ply", "gsplat_edu.io.compressed_ply", "SuperSplat compressed PLY"),
    Format(".ply", "gsplat_edu.io.ply", "Inria PLY"),
    Format(".splat", "gsplat_edu.io.splat", "antimatter splat", sh_degree=0, metadata=False),
    Format(".ksplat", "gsplat_edu.io.ksplat", "GaussianSplats3D's KSPLAT", sh_degree=2, metadata=False),
    Format(".spz", "gsplat_edu.io.spz", "Niantic SPZ"),
    Format(".sog", "gsplat_edu.io.sog.codec", "PlayCanvas SOG"),
    Format(".glb", "gsplat_edu.io.glb", "glTF with KHR_gaussian_splatting"),
    Format(".usda", "gsplat_edu.io.usd", "USD as text"),
    Format(".usdc", "gsplat_edu.io.usd", "binary USD"),
    Format(".usdz", "gsplat_edu.io.usd", "USD's package"),
    Format(".rad", "gsplat_edu.io.rad", "Spark's RAD"),
    Format(".csv", "gsplat_edu.io.csv", "CSV of splats", metadata=False),
    Format(".las", "gsplat_edu.io.las", "LAS of centres", sh_degree=0),
    Format(".laz", "gsplat_edu.io.las", "compressed LAS of centres", sh_degree=0),
    *plugins("formats").values(),
)
"""The first matching suffix wins; those of plug-ins come last. Those in `POINT_SUFFIXES` can only be written."""

SOG_META = "meta.json"
"""File that represents a SOG stored as a folder."""

LOD_META = "lod-meta.json"
"""File that represents a folder with levels of detail."""

TILESET = "tileset.json"
"""File that represents a folder of 3D Tiles."""

LOD_FORMATS: tuple[Format, ...] = (
    Format(LOD_META, "gsplat_edu.io.lod.codec", "PlayCanvas streamed SOG"),
    Format(TILESET, "gsplat_edu.io.lod.tiles", "3D Tiles"),
)
"""Folders with levels of detail, by the whole name of the file that represents them."""

READ_FORMATS: tuple[Format, ...] = (
    Format(".lcc", "gsplat_edu.io.lcc", "XGRIDS LCC"),
    Format(".lcc2", "gsplat_edu.io.lcc2", "XGRIDS LCC2"),
)
"""Folders of other programs that are read and not written, by the suffix of the file that represents them."""

READ_ONLY = "is read, but not written; choose another format"
"""Why such a folder is not a scene to write, after the name of the format."""


def format_of(path: str | Path) -> Format:
    """Return the format that a file's name indicates.

    Args:
        path: The file's name; it need not exist. meta.json denotes a SOG folder, lod-meta.json levels of detail.

    Raises:
        ArgumentError: the name has no suffix of a scene format.
    """
    name = Path(path).name.lower()
    if name == SOG_META:
        name = ".sog"
    for candidate in (*LOD_FORMATS, *FORMATS, *READ_FORMATS):
        if name.endswith(candidate.suffix) and (candidate not in LOD_FORMATS or name == candidate.suffix):
            return candidate
    known = ", ".join(candidate.suffix for candidate in (*FORMATS, *LOD_FORMATS))
    raise ArgumentError(f"{path}: unknown scene format; known are {known}")


def stored_bytes(path: Path) -> int:
    """Return the size of a scene on disk in bytes; for a folder, that of all files with splats."""
    for found in READ_FORMATS:
        if path.name.lower().endswith(found.suffix):
            return sum(file.stat().st_size for file in importlib.import_module(found.module).files_of(path))
    if path.name.lower() == LOD_META:
        from gsplat_edu.io.lod.codec import stored_bytes as of_all_levels

        return of_all_levels(path)
    if path.name.lower() == TILESET:
        return sum(file.stat().st_size for file in (path, *(path.parent / "tiles").glob("*.glb")))
    if path.name.lower() != SOG_META:
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.parent.iterdir() if file.suffix in (".json", ".webp"))


def losses(path: str | Path, scene: Scene) -> list[str]:
    """List the parts of a scene that the format of a path cannot store, one sentence each."""
    found, degree = format_of(path), scene.gaussians.sh_degree
    if found.suffix in POINT_SUFFIXES:
        of_points: list[str] = importlib.import_module(found.module).losses(path, scene)
        return of_points
    said = []
    if degree > found.sh_degree:
        said.append(
            f"{path}: {found.name} stores SH up to degree {found.sh_degree}; degrees up to {degree} are dropped"
        )
    if scene.antialiased and not found.metadata:
        said.append(f"{path}: {found.name} cannot store that the scene needs antialiased rendering")
    if scene.origin != ORIGIN and not found.metadata:
        where = ", ".join(f"{x:.15g}" for x in scene.origin)
        said.append(
            f"{path}: {found.name} cannot store the origin ({where}); add it, in double, to every coordinate"
        )
    if scene.earth is not None and not found.metadata:
        said.append(f"{path}: {found.name} cannot store where on earth the scene is: {scene.earth}")
    return said


MODELS = ("point_cloud/iteration_*/point_cloud.ply", "ply/point_cloud_*.ply")
"""Scenes in a model of Kerbl et al.'s code and in results of gsplat's trainer; the one of the last iteration counts."""

EXPORT = "splat.ply"
"""Scene in an export of nerfstudio. A capture, which has folders too, may hold a file of this name."""


def file_in(path: Path) -> Path:
    """Return the file that represents a scene stored as a folder; any other path as it is.

    Args:
        path: A SOG, levels of detail, 3D Tiles, an LCC, or the folder of a model that another program has written; a
            run of ours is no scene.
    """
    if not path.is_dir():
        return path
    for name in (SOG_META, LOD_META, TILESET):
        if (path / name).is_file():
            return path / name
    if len(found := [file for known in READ_FORMATS for file in path.glob(f"*{known.suffix}")]) == 1:
        return found[0]
    if (path / RUN_CONFIG).is_file():
        return path
    if found := [file for pattern in MODELS for file in path.glob(pattern)]:
        return max(found, key=_number)
    is_export = (path / EXPORT).is_file() and not any(entry.is_dir() for entry in path.iterdir())
    return path / EXPORT if is_export else path


def _number(file: Path) -> tuple[int, str]:
    """Return the iteration that a model's path names, and the path."""
    digits = re.findall(r"_([0-9]+)", file.as_posix())
    return int(digits[-1]) if digits else -1, file.as_posix()


def read_scene(path: str | Path) -> Scene:
    """Read a scene of any format.

    Args:
        path: The file; for a SOG folder, the folder or its meta.json; for levels of detail, of which the finest is
            read, the folder or its lod-meta.json, tileset.json, .lcc or .lcc2.

    Returns:
        The scene, float32, in this package's axes.

    Raises:
        ArgumentError: the name has no suffix of a scene format.
        SceneFormatError: the file does not match its suffix, or is damaged.
        OSError: the file cannot be read.
    """
    path = file_in(Path(path))
    found = format_of(path)
    scene = found.read(path)
    if not all(is_finite(tensor) for tensor in scene.gaussians.tensors().values()):
        bad = int((~scene.gaussians.finite_rows()).sum())
        raise SceneFormatError(f"{path}: {bad} splats have NaN or infinite values; export the scene again")
    return scene


def write_scene(path: str | Path, scene: Scene | Gaussians) -> None:
    """Write a scene in the format that the file's name indicates; parent folders are created.

    Args:
        path: The file; for a SOG folder, its meta.json; for levels of detail, lod-meta.json.
        scene: The scene, or bare Gaussians, in this package's axes.

    Raises:
        ArgumentError: the name has no suffix of a format that is written, the scene is neither, or a parameter is NaN
            or infinite.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    found = format_of(path)
    if found in READ_FORMATS:
        raise ArgumentError(f"{path}: {found.name} {READ_ONLY}")
    if isinstance(scene, Gaussians):
        scene = Scene(scene.map(Tensor.detach))
    of_type("scene", scene, Scene)
    scene.gaussians.check_finite()
    found.write(Path(path), scene)
