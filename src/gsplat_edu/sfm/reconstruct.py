"""Turn photos or a video into a capture in stages; an interrupted run resumes after the last completed stage.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import remove_leftovers
from gsplat_edu.data.notes import UnreadColors
from gsplat_edu.data.scale import Scale
from gsplat_edu.io.edit import Similarity
from gsplat_edu.photos.decoding import UPRIGHT
from gsplat_edu.scene.camera import Camera
from gsplat_edu.sfm import pairs
from gsplat_edu.sfm.candidates import Candidates
from gsplat_edu.sfm.colmap import (
    COLMAP_SEED,
    call,
    forget_features,
    forget_matches,
    limit_features,
    require_colmap,
)
from gsplat_edu.sfm.diagnosis import (
    COMPLETE,
    FEW_FEATURES,
    INLIERS,
    WEAK_SHARE,
    WEAK_THRESHOLD,
    diagnosis,
    evidence,
)
from gsplat_edu.sfm.given import FEWEST_GIVEN, GivenPoses, find_given, leave_unused
from gsplat_edu.sfm.mapping import FROM_GIVEN, Cameras, attempts, map_photos, rig_attempts, shared_cameras
from gsplat_edu.sfm.masks import check_some_used, find_masks, unused_folders
from gsplat_edu.sfm.options import SfmOptions as SfmOptions, lens_choice
from gsplat_edu.sfm.panoramas import (
    Panorama,
    are_panoramas,
    color_problems,
    cut_panoramas,
    face_facts,
    face_groups,
    moving_line,
    rig_of,
)
from gsplat_edu.sfm.photos import (
    PhotoFacts,
    camera_kinds,
    copy_photos,
    fingerprint,
    mask_folder,
    photo_facts,
    photo_files,
    stored_mask,
)
from gsplat_edu.sfm.result import build_capture, note_published, publish, published
from gsplat_edu.sfm.scale import Sight, in_given_world, placed
from gsplat_edu.sfm.search import Groups, find_features
from gsplat_edu.sfm.source import FEWEST, check_source, listed, too_few
from gsplat_edu.sfm.stages import Stages
from gsplat_edu.sfm.video import choose_frames, is_video, write_frames
from gsplat_edu.sfm.whole_photos import WholePhotos
from gsplat_edu.sfm.wide_lenses import CameraGroup, camera_groups, circles_of, lens_lines, write_lens_masks

FEATURES, MAPPING = 4, 4
"""Versions of the methods. They are part of the stages' options, so results of an earlier version in a work folder are
recomputed. Version 2 limits features to `max_features` and judges poses. Version 3 shares focal lengths between sizes;
version 4 also if every photo has its own size. Version 4 of the features searches as coarsely as finds enough."""

FACES = 1
"""Version of the method that cuts panoramas."""

PHOTOS = 3
"""Version of the method that copies photos. Version 2 reads the facts of the photos from their headers; version 3
decodes JPEGs at a smaller size."""

Say = Callable[[str], None]
Progress = Callable[[str, int, int], None]
"""Called with the stage, the amount done, and the total."""


def reconstruct(
    options: SfmOptions,
    say: Say = lambda sentence: None,
    progress: Progress = lambda stage, done, total: None,
) -> Path:
    """Find the poses of photos, and write a capture in COLMAP's layout: undistorted photos, fisheyes, panoramas.

    Features, matches and the order of all random draws are the same in every run. The mappers' order of summation
    depends on their threads, so poses of different runs agree to a fraction of a pixel but not to the bit. With one
    thread they agree to the bit.

    Args:
        options: The options.
        say: Receives sentences for the user.
        progress: Called with the progress of each stage. An exception from it ends the run, which can be resumed.

    Returns:
        The capture's folder, `options.out`.

    Raises:
        ArgumentError: pycolmap is not installed, or the output folder cannot be used.
        DatasetError: there are no photos, or too few of them get a pose: the message names the cause. Fewer than
            `COMPLETE` of them still make a capture, which is written first. If no stage was completed, the folders
            created for the run are removed.
        OSError: a file cannot be written.
    """
    require_colmap()
    files = check_source(options.source, options.out)
    folder = options.out / "sfm"
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    run = _Run(options, say, progress)
    try:
        return run.run(files)
    except DatasetError:
        if made and not run.stages.any_finished:  # nothing to resume: leave no folder behind
            shutil.rmtree(folder)
            for place in made[1:]:
                with suppress(OSError):
                    place.rmdir()
        raise


class _Run:
    """The stages of one run, each with the options that determine its result."""

    def __init__(self, options: SfmOptions, say: Say, progress: Progress) -> None:
        self.options, self._say, self._progress = options, say, progress
        self.folder = options.out / "sfm"
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)
        if parts := published(self.folder):
            note_published(
                self.folder, parts
            )  # read now, because the stage that records them may be discarded
        self.stages = Stages(self.folder / "stages.json", say)
        self.video = is_video(options.source)
        self.panoramas: list[Panorama] | None = None
        self.given: GivenPoses | None = None
        self.cameras: list[CameraGroup] = []
        """The photos by camera; empty for panoramas, whose faces have known cameras."""
        self.unit = 1
        """Photos with one pose: a panorama's faces."""
        self.threads = options.threads or -1

    def run(self, files: list[Path]) -> Path:
        """Run the stages."""
        options, source = self.options, self.options.source
        if self.video:
            wanted = {"video": fingerprint([source], source.parent), "frames": options.frames}
            self._stage("frames", wanted, self._take_frames, [self.folder / "frames"])
            source = self.folder / "frames"
            files = photo_files(source)
        check_some_used(files)
        self.whole = WholePhotos()
        if are_panoramas(files, options.panorama, self._say):
            leave_unused(source, options.poses, self._say)
            files = self._faces(files)
        elif not self.video:
            self.given = find_given(source, options.poses, files, self._say)
        self.source = source = files[0].parent
        masks = find_masks(files)
        wanted = {
            "photos": fingerprint(files, source),
            "max_image_size": options.max_image_size,
            "masks": fingerprint(sorted(masks.values()), source) if masks else "",
            "method": PHOTOS,
        }
        copies = self.folder / "photos"
        facts = self._stage("photos", wanted, lambda: self._copy(files), [copies, mask_folder(copies)])
        known = set(facts["names"])
        self.photos = [photo for photo in photo_facts(files, source, copies) if photo.name in known]
        if self.panoramas is None:
            self._group(copies)
        else:
            self.photos = face_facts(self.photos, self.panoramas)
            self.groups = face_groups(self.photos, options.max_image_size)
        database = [self.folder / f"database.db{ending}" for ending in ("", "-wal", "-shm")]
        self._find_features(database)
        forget = partial(forget_matches, database[0])
        facts = self._stage("matches", {"matcher": options.matcher}, self._match, [], forget)
        connected = self._find_poses(facts)
        if line := moving_line(self.model.get("moving", 1.0)):
            self._say(line)
        if not all((options.out / part).is_dir() for part in ("images", "sparse/0")):
            self.stages.forget("capture")
        wanted = {} if options.scale == AUTO else {"scale": options.scale}
        self._stage("capture", wanted, self._finish, [])
        count, total = len(self.model["names"]) // self.unit, len(self.photos) // self.unit
        if count < COMPLETE * total:
            said = f"only {count} of {total} {self._kind} have a pose; {self._diagnosis(connected)}"
            raise DatasetError(f"{options.out}: {said}; the incomplete capture is kept")
        return options.out

    def _find_poses(self, matches: Mapping[str, Any]) -> int:
        """Map the photos. If only likely pairs were matched, match more of photos left out, and map again.

        Args:
            matches: The facts of the stage "matches".

        Returns:
            The number of connected photos.
        """
        options = self.options
        connected: int = matches["connected"]
        wanted = {"mapper": options.mapper, "camera_model": options.camera_model, "method": MAPPING}
        if self.given is not None:
            wanted["poses"] = self.given.digest()

        def mapped(stage: str) -> dict[str, Any]:
            return self._stage(stage, wanted, lambda: self._map(connected), [self.folder / "models"])

        failure: DatasetError | None = None
        try:
            self.model = mapped("mapping")
        except DatasetError as error:
            if matches.get("kind") != "likely":
                raise
            self.model, failure = {"names": []}, error
        names = set(self.model["names"])
        posed = [i for i, photo in enumerate(self.photos) if photo.copy in names]
        if matches.get("kind") != "likely" or len(posed) == len(self.photos):
            return connected
        more = self._stage("more matches", {}, lambda: self._match_more(posed, matches["matched"]), [])
        connected = more["connected"]
        if more["matched"] > matches["matched"]:
            self.model = mapped("mapping again")
        elif failure is not None:
            raise failure
        return connected

    def _diagnosis(self, connected: int) -> str:
        copies = [self.folder / "photos" / photo.copy for photo in self.photos]
        return diagnosis(evidence(self.folder, copies, connected))

    def _group(self, copies: Path) -> None:
        """Group the photos by camera, and say which are fisheyes."""
        options = self.options
        self.cameras = camera_groups(self.photos, copies, options.max_image_size, options.camera_model)
        for line in lens_lines(self.cameras):
            self._say(line)
        self.groups = [group.json() for group in self.cameras]
        self.whole = WholePhotos(circles_of(self.cameras))

    def _stage(
        self,
        name: str,
        wanted: dict[str, Any],
        work: Callable[[], dict[str, Any]],
        rubbish: Sequence[Path],
        tidy: Callable[[], None] = lambda: None,
    ) -> dict[str, Any]:
        """Run a stage unless it is complete.

        Args:
            name: The stage.
            wanted: The options that determine its result.
            work: Runs the stage and returns its facts; "summary" is for the user.
            rubbish: Paths removed before the stage starts over.
            tidy: Further cleaning at that point.
        """
        facts = self.stages.finished(name, wanted)
        if facts is not None:
            self._say(f"{name}: {facts['summary']} (done before)")
            return facts
        if not self.stages.begin(name, wanted):
            for path in rubbish:
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
            tidy()
        began = time.perf_counter()
        facts = work()
        seconds = time.perf_counter() - began
        self.stages.end(name, facts | {"seconds": round(seconds, 2)})
        self._say(f"{name}: {facts['summary']} ({seconds:.1f} s)")
        return facts

    def _take_frames(self) -> dict[str, Any]:
        source, folder = self.options.source, self.folder / "frames"
        shutil.rmtree(folder, ignore_errors=True)
        chosen = choose_frames(source, self.options.frames, self._progress)
        written = write_frames(source, chosen, folder, self._progress)
        if len(written) < 3:
            raise DatasetError(
                f"{source}: the camera moves too little (only {len(written)} frames differ from the previous one); "
                "walk around the subject while filming"
            )
        same = (
            f", {len(chosen) - len(written)} near-duplicates left out" if len(written) < len(chosen) else ""
        )
        return {"summary": f"{len(written)} of {source.name}{same}"}

    def _faces(self, files: Sequence[Path]) -> list[Path]:
        """Cut panoramas; return the faces."""
        folder, masks = self.folder / "faces", find_masks(files)
        wanted = {
            "panoramas": fingerprint(files, files[0].parent),
            "masks": fingerprint(sorted(masks.values()), files[0].parent) if masks else "",
            "method": FACES,
        }
        facts = self._stage("faces", wanted, lambda: self._cut(files, folder), [folder])
        self.panoramas = [
            Panorama(one["name"], tuple(one["faces"]), _place(one["place"])) for one in facts["panoramas"]
        ]
        self.unit = len(self.panoramas[0].faces)
        named = {path.name: mask for path, mask in masks.items()}
        self.whole = WholePhotos({}, self.panoramas, files[0].parent, named)
        return [folder / name for panorama in self.panoramas for name in panorama.faces]

    def _cut(self, files: Sequence[Path], folder: Path) -> dict[str, Any]:
        found, side, unreadable = cut_panoramas(files, folder, None, self._progress)
        if unreadable:
            self._say(f"left out, cannot be decoded: {listed(unreadable)}")
        if len(found) < FEWEST:
            raise DatasetError(too_few(files[0].parent, len(found), unreadable))
        for note in UnreadColors.of(color_problems(files)):
            self._say(str(note))
        summary = f"{len(found)} panoramas cut into {len(found[0].faces)} faces each of {side}x{side} px"
        return {"summary": summary, "panoramas": [asdict(one) for one in found]}

    def _copy(self, files: Sequence[Path]) -> dict[str, Any]:
        longest = self.options.max_image_size
        photos, unreadable = copy_photos(
            files,
            self.source,
            self.folder / "photos",
            longest,
            lambda *count: self._progress("photos", *count),
        )
        if unreadable:
            self._say(f"left out, cannot be decoded: {listed(unreadable)}")
        if len(photos) < FEWEST:
            raise DatasetError(too_few(self.source, len(photos), unreadable))
        known = sum(photo.focal is not None for photo in photos)
        summary = f"{len(photos)} from {camera_kinds(photos)}; {known} with a focal length in EXIF"
        if self.panoramas is not None:
            summary = f"{len(photos)} faces of {len(self.panoramas)} panoramas"
        if masked := sum(bool(photo.mask) for photo in photos):
            summary += "; all have a mask" if masked == len(photos) else f"; {masked} of them have a mask"
        self._note_masks(files, photos)
        for note in UnreadColors.of([(photo.name, photo.problem) for photo in photos]):
            self._say(str(note))
        return {"summary": summary, "names": [photo.name for photo in photos], "unreadable": unreadable}

    def _note_masks(self, files: Sequence[Path], photos: Sequence[PhotoFacts]) -> None:
        """Report the masks that are not used, and those whose orientation is ambiguous."""
        for folder in unused_folders(files, find_masks(files)):
            if not folder.is_relative_to(self.folder):  # beside the faces of panoramas lie the copies' masks
                self._say(f"{folder}: not used, because none of its images is named like a photo")
        stored = stored_mask(self.folder / "photos", "").parent
        unknown = [
            photo.name
            for photo in photos
            if photo.mask
            and (photo.turns or photo.sensor != UPRIGHT)
            and (photo.turns % 2 == 0 or photo.W == photo.H)
            if Path(photo.mask).parent != stored
        ]
        if unknown:
            self._say(
                f"masks assumed to be stored like their photos, not upright (their sizes fit both): {listed(unknown)}"
            )

    def _find_features(self, database: list[Path]) -> None:
        """Find features; where photos have few, again with a lower threshold."""
        wanted = {
            "max_features": self.options.max_features,
            "pycolmap": version("pycolmap"),
            "method": FEATURES,
        }
        if lenses := [group["lens"] for group in self.groups if group.get("lens")]:
            wanted |= {"fisheyes": lenses}
        facts = self._stage("features", wanted, self._features, database)
        few, sift = facts["few"], {"peak_threshold": WEAK_THRESHOLD}
        if len(few) >= WEAK_SHARE * len(self.photos) and self.panoramas is None:
            counted = f"{len(few)} of {len(self.photos)} photos have fewer than {self._least} features"
            self._say(f"{counted}; searching them again with a threshold of {WEAK_THRESHOLD}")
            forget = partial(forget_features, database[0], few)
            self._stage("more features", sift, lambda: self._features(sift), [], forget)

    @property
    def _least(self) -> int:
        """A photo with fewer features has too few."""
        return min(FEW_FEATURES, self.options.max_features // 2)

    def _features(self, sift: Mapping[str, float] | None = None) -> dict[str, Any]:
        total, most, database = len(self.photos), self.options.max_features, self.folder / "database.db"
        masks = write_lens_masks(
            self.cameras, mask_folder(self.folder / "photos"), self.folder / "lens_masks"
        )

        def find(groups: Groups, settings: Mapping[str, float], into: Path) -> dict[str, int]:
            count = sum(len(group["names"]) for group in groups)
            stage = "features" if count == total else "trying features"
            found: dict[str, int] = self._call(
                "features",
                lambda done: self._progress(stage, min(done, count), count),
                database=str(into),
                photos=str(self.folder / "photos"),
                masks=str(masks) if masks.is_dir() else "",
                groups=groups,
                sift={"max_num_features": most, **settings},
            )["features"]
            return found

        found = (
            find_features(find, self.groups, database) if sift is None else find(self.groups, sift, database)
        )
        limit_features(database, most)
        found = {name: min(count, most) for name, count in found.items()}
        names = [photo.name for photo in self.photos if not found.get(photo.copy)]
        if names:
            self._say(f"no features found, because blank or out of focus: {listed(names)}")
        few = [photo.copy for photo in self.photos if found.get(photo.copy, 0) < self._least]
        return {"summary": f"{sum(found.values()):,} in {total - len(names)} photos", "few": few}

    def _match(self) -> dict[str, Any]:
        count, kind, candidates = len(self.photos), self.options.matcher, self._candidates()
        if kind == "auto":
            kind = candidates.automatic()
        chosen = candidates.of(kind)
        if kind != self.options.matcher and (reason := candidates.reason(kind)):
            self._say(
                f"{reason}; {len(chosen):,} pairs are matched instead of all {math.comb(count, 2):,}; "
                "for all, run gsplat-edu sfm with --matcher exhaustive"
            )
        verified = self._match_pairs(chosen)
        part = self._connected(verified)
        if len(part) < count and self.options.matcher in ("auto", "likely") and kind != "exhaustive":
            # Neighbours in the sequence and similar photos did not connect all photos: try more pairs of the others.
            chosen |= candidates.farther(kind, part)
            verified = self._match_pairs(chosen)
            part = self._connected(verified)
        if not verified:
            raise DatasetError(f"{self.options.source}: no two photos match; {self._diagnosis(0)}")
        summary = f"{len(verified):,} of {len(chosen):,} pairs match"
        if len(part) < count:
            summary += f"; {len(part) // self.unit} of {count // self.unit} {self._kind} are connected"
        return {"summary": summary, "connected": len(part), "kind": kind, "matched": len(verified)}

    def _match_more(self, posed: Sequence[int], before: int) -> dict[str, Any]:
        """Match more pairs of the photos without a pose, after likely pairs.

        Args:
            posed: The other photos.
            before: Number of pairs that match so far.
        """
        left = len(self.photos) - len(posed)
        self._say(f"{left} photo{'s have' if left > 1 else ' has'} no pose: matching more of their pairs")
        candidates = self._candidates()
        verified = self._match_pairs(candidates.of("likely") | candidates.farther("likely", posed))
        summary = f"{len(verified) - before:,} more pairs match"
        return {"summary": summary, "connected": len(self._connected(verified)), "matched": len(verified)}

    def _candidates(self) -> Candidates:
        compared = partial(self._progress, "comparing photos")
        return Candidates(self.photos, self.folder / "database.db", self.video, self.unit, compared)

    @property
    def _kind(self) -> str:
        return "photos" if self.panoramas is None else "panoramas"

    def _connected(self, verified: Sequence[pairs.Pair]) -> list[int]:
        """Return the photos of the largest connected part; the faces of a panorama are connected."""
        unit = self.unit
        units = [(a // unit, b // unit) for a, b in verified]
        part = pairs.largest_part(len(self.photos) // unit, units)
        return [unit * one + face for one in part for face in range(unit)]

    def _match_pairs(self, chosen: set[pairs.Pair]) -> list[pairs.Pair]:
        """Match the pairs that are not matched yet; return all pairs that are connected."""
        names = [photo.copy for photo in self.photos]
        listed = self.folder / "pairs.txt"
        listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in sorted(chosen)), encoding="utf-8")
        verified = self._call(
            "matches",
            lambda done: self._progress("matches", min(done, len(chosen)), len(chosen)),
            pairs=str(listed),
        )["verified"]
        number = {name: i for i, name in enumerate(names)}
        return [(number[a], number[b]) for a, b, count in verified if count >= INLIERS]

    def _map(self, connected: int) -> dict[str, Any]:
        options, total = self.options, len(self.photos)
        if self.panoramas is None:
            shared = shared_cameras(self.groups)
            cameras = Cameras(shared, given=self._given_model())
            used = len(self.groups) - len(shared)
            lens, _ = lens_choice(options.camera_model)
            ways = attempts(options.mapper, lens, total, used, self.video)
            if all(group.lens is not None for group in self.cameras):
                ways = [way for way in ways if not way.free]  # a freer lens than a fisheye is none
            ways = [FROM_GIVEN, *ways] if cameras.given else ways
        else:
            cameras, ways = Cameras({}, rig_of(self.photos)), rig_attempts(options.mapper)
        model = map_photos(
            self.folder, ways, cameras, total, connected, self.threads, self._say, self._progress
        )
        count, total = len(model["names"]) // self.unit, total // self.unit
        summary = f"{count} of {total} {self._kind} have a pose ({model['way']})"
        if cameras.given is not None:
            summary += self._said_of_given(model, cameras.given)
        unclear = len(set(model["unclear"]) - set(model["names"]))
        if left := total - count - unclear:
            others = f"{left} more" if unclear else f"the other {left}" if left > 1 else "the other one"
            summary += f"; {others} share{'s' * (left == 1)} too little with them"
        if unclear:
            summary += f"; the focal length of {unclear} of another size is unclear"
        return model | {"summary": summary}

    def _said_of_given(self, model: Mapping[str, Any], given: Mapping[str, Any]) -> str:
        """Return the words of the summary about given poses, and say what became of them."""
        assert self.given is not None, "their model is made of them"
        program = self.given.program
        if "held" not in model:
            self._say(f"the poses of {program} are not used: without them, more photos have a pose")
            return ""
        if model["held"]:
            self._say(f"the photos match too little to refine the poses of {program}, which stay as they are")
        more = len(set(model["names"]) - {view["name"] for view in given["views"]})
        return f", {more} more than those of {program}"

    def _given_model(self) -> dict[str, Any] | None:
        """Return the given poses and lenses of the working copies; None if the photos do not agree with any."""
        if self.given is None or (given := self.given.proven(self._say)) is None:
            return None
        model = given.model(self.photos, self.groups, self.options.max_image_size)
        return model if len(model["views"]) >= FEWEST_GIVEN else None

    def _placed(
        self, cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"], sights: Sequence[Sight]
    ) -> tuple[Similarity, Scale | None]:
        """Choose the world: that of the given poses if the model started from them."""
        if self.given is not None and "held" in self.model:
            return in_given_world(sights, self.options.scale, self.given.reader.capture.scale)
        return placed(cameras, points, sights, self.options.scale, self._say)

    def _finish(self) -> dict[str, Any]:
        facts = build_capture(
            self.model,
            self.photos,
            self.source,
            self.folder,
            self._progress,
            self._placed,
            self._say,
            self.whole,
        )
        publish(self.folder, self.options.out)
        if scale := Scale.parsed("scale", facts["scale"]):
            self._say(f"scale: {scale}")
        if self.panoramas is not None:
            names = {face: one.name for one in self.panoramas for face in one.faces}
            for kind in ("left_out", "doubtful"):
                facts[kind] = list(dict.fromkeys(names[face] for face in facts[kind]))
        if facts["left_out"]:
            self._say(f"left out, no pose was found: {listed(facts['left_out'])}")
        if facts["unclear"]:
            self._say(
                "left out, because their size differs from the main camera's and no single focal length explains them: "
                f"{listed(facts['unclear'])}; use photos as the camera wrote them, neither cropped nor scaled"
            )
        if facts["doubtful"]:
            self._say(
                "left out, because they overlap too little with the others to trust the pose: "
                f"{listed(facts['doubtful'])}"
            )
        figures = f"{facts['points']:,} points, mean reprojection error {facts['error']:.2f} px"
        return facts | {"summary": f"{self._kept()}, {figures}"}

    def _kept(self) -> str:
        """Say how many photos were undistorted, and how many keep their lens."""
        placed = set(self.model["names"])
        if self.panoramas is not None:
            return f"{len(placed) // self.unit} panoramas, whole (train --lens native uses them so)"
        wide = {photo.copy for group in self.cameras if group.lens is not None for photo in group.photos}
        counts = ((len(placed - wide), "undistorted"), (len(placed & wide), "with their own lens"))
        return ", ".join(f"{count} photos {how}" for count, how in counts if count)

    def _call(self, job: str, progress: Callable[[int], None], **arguments: object) -> dict[str, Any]:
        common = {"database": str(self.folder / "database.db"), "threads": self.threads, "seed": COLMAP_SEED}
        return call(job, self.folder / "log.txt", progress, **(common | arguments))


def _place(value: Sequence[float] | None) -> tuple[float, float, float] | None:
    return None if value is None else (value[0], value[1], value[2])
