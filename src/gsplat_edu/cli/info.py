"""`gsplat-edu info`: summarise a dataset, a run, a scene or mesh file, or this computer on one screen."""

from __future__ import annotations

import argparse
import os
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError, CheckpointError, SceneFormatError
from gsplat_edu.base.text import short_number
from gsplat_edu.budget.choice import usual_choice
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.data.dataset import Dataset, DataSettings, scene_extent
from gsplat_edu.data.reader import CaptureReader, layout_of
from gsplat_edu.data.scale import Scale
from gsplat_edu.engine import adapters
from gsplat_edu.evaluate.verdict import skipped_views
from gsplat_edu.io import ply
from gsplat_edu.io.formats import (
    FORMATS,
    LOD_META,
    SOG_META,
    file_in,
    format_of,
    read_scene,
    stored_bytes,
)
from gsplat_edu.io.lod.codec import read_index
from gsplat_edu.io.mesh_files import MESH_FORMATS, mesh_format_of
from gsplat_edu.render.backends import BACKENDS, gpu_of, unavailable
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from gsplat_edu.survey.proof import prove

PERCENTILES = (1, 25, 50, 75, 99)

BINS = 40
"""Bins of a histogram, one character each."""

BLOCKS = " ▁▂▃▄▅▆▇█"
"""Bar characters by height; the first marks an empty bin."""

PLAIN_BLOCKS = " .:-=+*#@"
"""The same for ASCII-only terminals."""

HIGHLIGHTS = {
    "data": ("path", "resolution", "test_every", "points"),
    "train": ("strategy", "max_gaussians", "ssim_weight", "surface", "seed"),
    "render": ("sh_degree", "background", "antialiased", "jacobian_limit"),
}
"""Settings of a run to show, by section of config.json; None values are skipped. report.html shows all settings."""

Fact = tuple[str, str]


def run(arguments: argparse.Namespace) -> None:
    """Print one fact per line."""
    if arguments.path is None:
        Terminal().say(*(f"{name:<10} {value}" for name, value in _computer_facts()))
        return
    path: Path = arguments.path
    if not path.exists():
        raise ArgumentError(f"{path}: does not exist; give a dataset folder, a run folder, a scene or a mesh")
    path = file_in(path)
    if path.is_file() and not _is_pose_file(path):
        facts = _file_facts(path)
    elif RunFolder(path).exists():
        facts = _run_facts(RunFolder(path))
    else:
        facts = _dataset_facts(path, arguments.trust_poses)
    console = Terminal()
    if not console.shows(BLOCKS):
        plain = str.maketrans(BLOCKS, PLAIN_BLOCKS)
        facts = [(name, value.translate(plain)) for name, value in facts]
    console.say(*(f"{name:<10} {value}".rstrip() for name, value in facts))


def _is_pose_file(path: Path) -> bool:
    """Return whether a file is a capture's, such as a transforms.json, and not a scene."""
    return path.name.lower() not in (SOG_META, LOD_META) and layout_of(path) is not None


def _computer_facts() -> list[Fact]:
    """Describe the processor, and for each backend where it runs or why it does not."""
    facts = [("computer", f"{platform.platform(terse=True)}, {os.cpu_count()} cores, {platform.machine()}")]
    for backend in BACKENDS:
        reason = unavailable(backend)
        facts.append(
            (backend, f"not available: {reason}" if reason else gpu_of(backend) or "on the processor")
        )
    facts.append(("auto", f"takes {_usual_choice()}"))
    if adapters.why_unavailable() is None:
        facts += [("adapter", f"{one.name}, {one.interface}, {one.driver}") for one in adapters.adapters()]
    return facts


def _usual_choice() -> str:
    """Return what `--backend auto` takes, and why."""
    reason = adapters.why_unavailable()
    try:
        return usual_choice(adapters.Listing(adapters.adapters() if reason is None else (), reason))
    except BackendUnavailableError as error:
        return f"none: {error}"


def _file_facts(path: Path) -> list[Fact]:
    """Describe a scene, or a mesh of one of the suffixes that both have or of its own."""
    suffix = path.suffix.lower()
    if suffix not in {each.suffix for each in MESH_FORMATS if each.reader}:
        return _scene_facts(path)
    if suffix not in {each.suffix for each in FORMATS}:
        return _mesh_facts(path)
    try:
        return _scene_facts(path)
    except SceneFormatError as error:
        try:
            return _mesh_facts(path)
        except SceneFormatError:
            raise error from None


def _mesh_facts(path: Path) -> list[Fact]:
    found = mesh_format_of(path)
    stored = found.read(path)
    mesh, texture = stored.mesh, stored.mesh.texture
    facts = [
        ("mesh", f"{path}, {found.name}"),
        ("triangles", f"{len(mesh.faces):,} of {len(mesh.vertices):,} vertices"),
        ("file", f"{path.stat().st_size:,} bytes"),
    ]
    if mesh.colors is not None:
        facts.append(("colours", "of vertices"))
    if texture is not None:
        facts.append(("texture", "{1} x {0} px".format(*texture.image.shape)))
    if stored.unit is not None:
        facts.append(("units", f"1 unit = 1 {stored.unit}"))
    if stored.earth is not None:
        middle = np.median(mesh.vertices, axis=0)
        facts.append(("on earth", f"middle at {stored.earth.place_of(middle)}"))
    facts.append(("extent", _bounds(mesh.vertices)))
    return facts


def _scene_facts(path: Path) -> list[Fact]:
    found = format_of(path)
    # NaN is reported here; other commands reject it
    scene = ply.read(path, finite=False) if found.suffix == ".ply" else read_scene(path)
    gaussians = scene.gaussians
    count, size = len(gaussians), stored_bytes(path)
    facts = [
        ("scene", f"{path}, {found.name}"),
        ("splats", f"{count:,}, SH degree {gaussians.sh_degree}"),
        ("file", f"{size:,} bytes" + (f", {size / count:.1f} per splat" if count else "")),
    ]
    if path.name.lower() == LOD_META:
        index = read_index(path)
        counts = ", ".join(f"{count:,}" for count in index.counts())
        leaves = f"{len(index.regions)} leaves in {len(index.filenames)} files"
        facts.append(
            ("levels", f"{index.levels} of {counts} splats, {leaves}; the finest one is described here")
        )
    if scene.antialiased is not None:
        facts.append(("render", f"{'with' if scene.antialiased else 'without'} antialiasing"))
    if scene.unit is not None:
        facts.append(("units", f"1 unit = 1 {scene.unit}"))
    if scene.origin != ORIGIN:
        where = ", ".join(f"{x:.15g}" for x in scene.origin)
        facts.append(("origin", f"{where}: added, in double, to the coordinates below"))
    if scene.earth is not None:
        facts.append(("on earth", f"zero at {scene.earth.place_of(scene.origin)}"))
    if scene.up is not None:
        facts.append(("up", ", ".join(f"{x:.4g}" for x in scene.up)))
    finite = gaussians.finite_rows()
    if broken := int((~finite).sum()):
        facts.append(
            ("warning", f"{broken:,} of {count:,} splats have NaN or infinite values and cannot be drawn")
        )
        gaussians = gaussians.map(lambda tensor: tensor[finite])
    return facts + _splat_facts(gaussians) if len(gaussians) else facts


def _splat_facts(gaussians: Gaussians) -> list[Fact]:
    means, scales = gaussians.means.double().numpy(force=True), gaussians.scales.double().numpy(force=True)
    opacities = gaussians.opacities.double().numpy(force=True)
    inner = np.percentile(means, (1, 99), axis=0)
    header = "percentiles " + ", ".join(str(p) for p in PERCENTILES)
    facts = [
        ("bounds", _bounds(means)),
        ("", f"middle 98 %: {_bounds(inner)}"),
        ("opacity", f"{_percentiles(opacities)}   ({header})"),
        ("", _histogram(opacities, np.linspace(0.0, 1.0, BINS + 1), "0", "1")),
        ("scale", f"{_percentiles(scales)}   world units"),
        ("", _log_histogram(scales)),
    ]
    if (far := far_shell(means)).any():
        facts.insert(
            1, ("", f"all but the {int(far.sum()):,} of a far shell, such as a sky: {_bounds(means[~far])}")
        )
    diagonal = float(np.linalg.norm(inner[1] - inner[0]))
    for number, what in (
        (
            int((gaussians.quats.detach() == 0).all(dim=1).sum()),
            "a quaternion of length zero and are never drawn",
        ),
        (
            int((scales > diagonal).any(axis=1).sum()) if diagonal else 0,
            "a scale larger than the diagonal of the middle 98 %",
        ),
        (int((opacities < ALPHA_MIN).sum()), "an opacity below 1/255 and are invisible"),
    ):
        if number:
            facts.append(("warning", f"{number:,} of {len(gaussians):,} splats have {what}"))
    return facts


def _run_facts(folder: RunFolder) -> list[Fact]:
    config, metrics, log = folder.read_config(), folder.read_metrics(), folder.log()
    planned = _section(config, "train").get("iterations")
    reached = f"iteration {log[-1].get('iteration')}" if log else "not started"
    facts = [
        ("run", f"{folder.path}, gsplat_edu {config.get('version', '?')}"),
        ("progress", f"{reached}" + (f" of {planned:,}" if isinstance(planned, int) else "")),
    ]
    for split in ("test", "train"):
        scores = _section(metrics, split)
        if scores.get("psnr") is not None:
            facts.append(
                (
                    split,
                    ", ".join(_scores(scores)),
                )
            )
    if skipped := skipped_views(metrics):
        unscored = f"--eval-every 0 skipped the scores of {skipped}; run: gsplat-edu eval {folder.path}"
        facts.append(("test", unscored))
    if not metrics:
        facts.append(("test", f"not evaluated yet; run: gsplat-edu eval {folder.path}"))
    if isinstance(seconds := metrics.get("seconds"), int | float):
        facts.append(("time", f"{seconds:.1f} s"))
    for key, names in HIGHLIGHTS.items():
        section = _section(config, key)
        said = [f"{name} {section[name]}" for name in names if section.get(name) is not None]
        if said:
            facts.append((key, ", ".join(said)))
    facts.append(("backend", str(config.get("backend", "?"))))
    if units := _section(config, "scale"):
        unit, source, detail = (str(units.get(name) or "?") for name in ("unit", "source", "detail"))
        known = Scale(unit, source, detail)
        facts.append(("units", str(known)))
    try:
        scene, iteration = folder.latest_scene()
    except CheckpointError as error:
        return [*facts, ("scene", str(error))]
    return [*facts, ("", f"after {iteration:,} iterations:"), *_scene_facts(scene)]


def _scores(scores: Mapping[str, Any]) -> list[str]:
    """Format a split's metrics; files of other programs may lack some."""
    ssim, images = scores.get("ssim"), scores.get("num_images")
    said = [f"PSNR {scores['psnr']:.2f} dB"]
    said += [] if ssim is None else [f"SSIM {ssim:.4f}"]
    return said + ([] if images is None else [f"{images} images"])


def _dataset_facts(path: Path, trust: bool) -> list[Fact]:
    reader = CaptureReader(path)
    proof = None if trust else prove(reader)
    if proof is not None:
        reader = reader.under(proof.reading or None)
    dataset = Dataset.of(reader, DataSettings())
    views = (*dataset.train, *dataset.test)
    cameras = [view.camera for view in views]
    sizes = Counter(f"{camera.W}x{camera.H}" for camera in cameras)
    lenses = Counter(f"fx {c.fx:.1f}, fy {c.fy:.1f}, cx {c.cx:.1f}, cy {c.cy:.1f}" for c in cameras)
    eyes = np.stack([camera.eye for camera in cameras])
    facts = [
        ("dataset", str(dataset.path)),
        ("layout", str(dataset.layout)),
        ("photos", f"{len(views)}: {_counted(sizes)}"),
        ("cameras", _counted(lenses)),
        ("lens", _counted(Counter(file.lens.described for _, file in dataset.files))),
        *_shutter_facts([frame.shutter for frame in reader.capture.frames]),
        *([] if proof is None else [("poses", str(proof))]),
        ("split", f"{len(dataset.train)} for training, {len(dataset.test)} held out"),
        ("extent", f"{short_number(scene_extent(cameras), 4)} world units"),
        ("positions", _bounds(eyes)),
        ("points", f"{len(dataset.points):,}"),
    ]
    if len(dataset.points):
        inner = np.percentile(dataset.points, (1, 99), axis=0)
        facts.append(("", f"middle 98 %: {_bounds(inner)}"))
    if dataset.scale is not None:
        facts.append(("units", str(dataset.scale)))
        if dataset.scale.earth is not None:
            middle = np.median(eyes, axis=0) + dataset.origin
            facts.append(("on earth", f"photos around {dataset.scale.earth.place_of(middle)}"))
    if np.any(dataset.origin):
        facts.append(("origin", f"shifted to {', '.join(f'{x:.6g}' for x in dataset.origin)}"))
    return facts + [("note", str(note)) for note in dataset.notes]


def _shutter_facts(shutters: Sequence[RollingShutter | None]) -> list[Fact]:
    """Describe the rolling shutters and the motion blur of a capture's photos, if there are any."""
    moving = [shutter for shutter in shutters if shutter is not None]
    rolling = [shutter for shutter in moving if shutter.readout != AT_ONCE]
    blurred = [shutter for shutter in moving if shutter.exposure]
    blur = [("motion blur", f"in {len(blurred)} of {len(shutters)} photos, by their exposure time")]
    if not rolling:
        return blur if blurred else []
    turn = float(np.median([np.linalg.norm(shutter.turn) for shutter in rolling]))
    shift = float(np.median([np.linalg.norm(shutter.shift) for shutter in rolling]))
    motion = f"turn {np.degrees(turn):.2g} degrees, shift {short_number(shift, 3)} world units (medians)"
    facts = [("shutter", f"rolling in {len(rolling)} of {len(shutters)} photos: {motion}")]
    return facts + (blur if blurred else [])


def _section(values: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    section = values.get(key)
    return section if isinstance(section, Mapping) else {}


def _counted(counter: Counter[str], most: int = 3) -> str:
    if len(counter) == 1:
        return next(iter(counter))
    parts = [f"{number} of {what}" for what, number in counter.most_common(most)]
    return "; ".join(parts) + (f"; {len(counter) - most} more kinds" if len(counter) > most else "")


def _bounds(points: Float[np.ndarray, "N 3"]) -> str:
    low, high = points.min(axis=0) + 0.0, points.max(axis=0) + 0.0  # no -0
    return ", ".join(
        f"{n} {short_number(a, 4)} to {short_number(b, 4)}" for n, a, b in zip("xyz", low, high, strict=True)
    )


def _log_histogram(values: Float[np.ndarray, "..."]) -> str:
    """Draw a histogram over the decades of the middle 99.8 %; values beyond count in the end bins."""
    logs = np.log10(np.maximum(values, np.finfo(np.float64).tiny))
    low, high = np.percentile(logs, (0.1, 99.9))
    edges = np.linspace(low, high if high > low else low + 1.0, BINS + 1)
    return _histogram(
        np.clip(logs, edges[0], edges[-1]), edges, f"{10 ** edges[0]:.2g}", f"{10 ** edges[-1]:.2g}"
    )


def _histogram(values: Float[np.ndarray, "..."], edges: Float[np.ndarray, " B"], low: str, high: str) -> str:
    """Draw a histogram as one line of bar characters, scaled to the highest bin."""
    counts, _ = np.histogram(values, edges)
    heights = np.ceil(counts / max(int(counts.max()), 1) * (len(BLOCKS) - 1)).astype(int)
    return f"{low} |{''.join(BLOCKS[height] for height in heights)}| {high}"


def _percentiles(values: Float[np.ndarray, "..."]) -> str:
    quantiles: Sequence[float] = np.percentile(values, PERCENTILES).tolist()
    return ", ".join(short_number(value, 4) for value in quantiles)
