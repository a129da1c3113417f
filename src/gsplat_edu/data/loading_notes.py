"""Notes about how a capture was loaded and divided: values with fields; `str` gives the sentence for the user."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.data.notes import NamedPhotos, Note, SomePhotos


@dataclass(frozen=True)
class IgnoredPoints:
    """Start points without a usable position.

    Args:
        points: Number of such points.
        total: Number of start points in the file.
    """

    points: int
    total: int

    def __str__(self) -> str:
        return f"{self.points} of {self.total} points are NaN, infinite or absurdly far away: ignored"


@dataclass(frozen=True)
class MovedOrigin:
    """A shift of all coordinates, which were too large for float32.

    Args:
        origin: (x, y, z) what was subtracted, world units.
    """

    origin: tuple[float, float, float]

    def __str__(self) -> str:
        return f"coordinates are large: {self.origin} was subtracted from all of them"


@dataclass(frozen=True)
class PanoramaFaces:
    """Views that are cut from panoramas.

    Args:
        faces: Number of such views.
        total: Number of views.
    """

    faces: int
    total: int

    def __str__(self) -> str:
        return f"{self.faces} of {self.total} views are faces of panoramas, cut on loading"


@dataclass(frozen=True)
class NativeLenses(SomePhotos):
    """Photos that keep their lens: they are rendered through it, not undistorted."""

    def __str__(self) -> str:
        return f"{self.counted} are trained through their own lens, without resampling"


@dataclass(frozen=True)
class RollingShutters(SomePhotos):
    """Photos that were read row by row by a moving camera, and are rendered so.

    Args:
        turn: Median angle by which their cameras turn meanwhile, degrees.
    """

    turn: float

    def __str__(self) -> str:
        return (
            f"{self.counted} have a rolling shutter, during which the camera turns by {self.turn:.2g} degrees "
            "(median): each row has its own pose"
        )


@dataclass(frozen=True)
class MotionBlurs(SomePhotos):
    """Photos whose camera moved while they were exposed, and that are rendered so."""

    def __str__(self) -> str:
        return (
            f"{self.counted} are rendered with the motion blur of their exposure time, so that the scene becomes "
            "sharp"
        )


@dataclass(frozen=True)
class IgnoredShutters(NamedPhotos):
    """Photos whose rolling shutter or motion blur is ignored: their cameras count as resting.

    Args:
        undistorted: Whether the photos may not keep their lens; otherwise the renderer lacks their lens model.
    """

    undistorted: bool

    def __str__(self) -> str:
        remedy = (
            "train --lens native renders it" if self.undistorted else "the renderer does not have their lens"
        )
        return f"{self.counted} have a rolling shutter or motion blur, which is ignored, first {self.first}: {remedy}"


@dataclass(frozen=True)
class DistortedPhotos(SomePhotos):
    """Photos that are undistorted."""

    def __str__(self) -> str:
        return f"{self.counted} have lens distortion and are undistorted on loading"


@dataclass(frozen=True)
class CroppedPhotos(NamedPhotos):
    """Photos with a wider field of view than a pinhole camera can show.

    Args:
        widest: Widest field of view that is kept whole, degrees.
        kept: Field of view of a cropped photo, degrees.
    """

    widest: int
    kept: int

    def __str__(self) -> str:
        return f"{self.counted} see more than {self.widest} degrees and are cropped to {self.kept}, first {self.first}"


@dataclass(frozen=True)
class RescaledIntrinsics(NamedPhotos):
    """Photos whose size differs from their camera's."""

    def __str__(self) -> str:
        return f"{self.counted} differ in size from their camera, first {self.first}: intrinsics rescaled"


@dataclass(frozen=True)
class UnevenFocalLengths:
    """Cameras whose two focal lengths differ more than those of real lenses.

    Args:
        cameras: Number of photos with such a camera.
        total: Number of photos.
        fx, fy: Focal lengths of the first such camera, px.
    """

    cameras: int
    total: int
    fx: float
    fy: float

    def __str__(self) -> str:
        return (
            f"{self.cameras} of {self.total} cameras have fx and fy that differ widely, first {self.fx:.4g} and "
            f"{self.fy:.4g} px: the calibration may be wrong"
        )


@dataclass(frozen=True)
class TurnedPhotos(NamedPhotos):
    """Photos that are turned by their EXIF orientation, because their poses refer to upright photos."""

    def __str__(self) -> str:
        return (
            f"{self.counted} are turned by their EXIF orientation, because their poses refer to upright photos, "
            f"first {self.first}"
        )


@dataclass(frozen=True)
class PhotosExceedMemory:
    """A photo cache that is too small for all photos.

    Args:
        needed: Bytes that all photos take.
        budget: Bytes of the cache.
    """

    needed: int
    budget: int

    def __str__(self) -> str:
        return (
            f"the photos take {_spelled(self.needed)} of memory, but only {_spelled(self.budget)} are kept: the others "
            "are decoded again whenever they are used; raise --image-memory, or load smaller photos with --resolution"
        )


def _spelled(nbytes: int) -> str:
    return f"{nbytes / 2**30:.1f} GiB" if nbytes >= 2**30 else f"{nbytes / 2**20:.4g} MiB"


@dataclass(frozen=True)
class UnlistedPhotos(SomePhotos):
    """Photos that neither the training nor the test list of the capture names."""

    def __str__(self) -> str:
        return f"{self.counted} are in none of the capture's training and test lists: left out"


@dataclass(frozen=True)
class OnlyOnePhoto:
    """A capture of one photo, which leaves none for testing."""

    def __str__(self) -> str:
        return "the capture has only one photo: it is used for training, and none is held out"


@dataclass(frozen=True)
class SharedCentres:
    """Photos that were taken from fewer places than there are photos.

    Args:
        photos: Number of photos.
        centres: Number of different camera centres.
    """

    photos: int
    centres: int

    def __str__(self) -> str:
        return (
            f"{self.photos} photos have {self.centres} centres, like the faces of panoramas: those with one centre are "
            "held out together"
        )


@dataclass(frozen=True)
class RandomStart:
    """Random start points, because the capture has none.

    Args:
        reason: Why the capture has no points.
        points: Number of random points.
        cube: Half the edge of the cube that contains them, world units; None if no cube limits them.
        shared: Whether they lie where two or more photos look. Otherwise no two photos see the same place, and the cube
            is centred on the cameras.
    """

    reason: str
    points: int
    cube: float | None
    shared: bool

    def __str__(self) -> str:
        if not self.shared:
            where = f"within {self.cube:.4g} of the cameras, since no two photos see the same place"
        elif self.cube is not None:
            where = f"in the cube +-{self.cube:g}, where two or more photos look"
        else:
            where = "where two or more photos look"
        return f"{self.reason}: starting from {self.points:,} random points {where}"


LoadingNote = (
    Note
    | IgnoredPoints
    | MovedOrigin
    | PanoramaFaces
    | NativeLenses
    | RollingShutters
    | MotionBlurs
    | IgnoredShutters
    | DistortedPhotos
    | CroppedPhotos
    | RescaledIntrinsics
    | UnevenFocalLengths
    | TurnedPhotos
    | PhotosExceedMemory
    | UnlistedPhotos
    | OnlyOnePhoto
    | SharedCentres
    | RandomStart
)
"""Anything that `Dataset.notes` may hold."""
