"""Settings for loading a capture. Imports nothing heavy, because the command line checks its options first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import float64_array, in_range, one_of, whole_number
from gsplat_edu.scene.region import Region

FACTOR_BELOW = 32
"""A resolution below this is a divisor of the size; from here on it is the longest side, px."""

LENS_MODES = ("undistort", "native", "auto")
"""Which photos are trained through their own lens: none; all whose model the renderer has; or fisheyes, panoramas,
photos with a rolling shutter, and photos of which undistortion would crop more than a tenth."""


@dataclass(frozen=True)
class DataSettings:
    """Settings for loading a capture.

    Args:
        resolution: None keeps the photos' size. Below 32, a factor that divides both sizes (2 for half). From 32 on,
            the longest side in px; photos are never enlarged.
        test_every: Hold out every n-th view by sorted name; 0 for none. This overrides the capture's own split. None
            uses the capture's split if it defines one, else every 8th view.
        background: (r, g, b), 0 to 1, composited behind photos with alpha on loading, which are opaque then. None
            keeps the alpha, which training and scores use.
        image_memory: Bytes of decoded photos to keep in memory; other photos are decoded again on each use.
        train_views: Names of the training views, at least one; only these and `test_views` are read, and no split is
            made. None uses every view.
        test_views: Names of the test views to go with `train_views`.
        left_out: Photos that are not used, as `gsplat_edu.data.left_out` names them; None uses the capture's own list.
            With `train_views`, it means nothing.
        region: The region of interest as `gsplat_edu.scene.region.Region.numbers` gives it, in the capture's
            coordinates; () for none. None uses the capture's region.json, if there is one.
        reading: Name of the reading of the poses and lenses, one of `gsplat_edu.data.conventions.READINGS`; None reads
            them as the capture's format says.
        lens: Which photos keep their lens instead of being undistorted, one of `LENS_MODES`.

    Raises:
        ArgumentError: a value is out of range, or the split would leave no training view.
    """

    resolution: float | None = None
    test_every: int | None = None
    background: tuple[float, float, float] | None = None
    image_memory: int = 4 * 2**30
    train_views: tuple[str, ...] | None = None
    test_views: tuple[str, ...] = ()
    lens: str = "undistort"
    left_out: tuple[str, ...] | None = None
    region: tuple[float, ...] | None = None
    reading: str | None = None

    def __post_init__(self) -> None:
        if self.resolution is not None and (in_range("resolution", self.resolution, 1.0) > 1e6):
            raise ArgumentError("resolution: is above 1e6; give a factor below 32 or the longest side in px")
        if self.test_every is not None and whole_number("test_every", self.test_every, 0) == 1:
            raise ArgumentError(
                "test_every: is 1, which leaves no training view; give 0 for none, or at least 2"
            )
        if self.background is not None:
            r, g, b = (
                in_range(f"background[{i}]", value, 0.0, 1.0)
                for i, value in enumerate(float64_array("background", self.background, (3,)))
            )
            object.__setattr__(self, "background", (r, g, b))
        one_of("lens", self.lens, LENS_MODES)
        if self.region:
            object.__setattr__(self, "region", Region.of_numbers(self.region).numbers)
        whole_number("image_memory", self.image_memory, 0)
        if self.train_views is not None and not self.train_views:
            raise ArgumentError("train_views: is empty; name at least one view, or give None for all")

    def completed(self, own: DataSettings) -> DataSettings:
        """Return the settings with those of `own` where they would use what the capture's files or photos say."""
        names = ("region", "reading", *(() if self.train_views is not None else ("left_out",)))
        given: dict[str, Any] = {name: getattr(own, name) for name in names if getattr(self, name) is None}
        return replace(self, **given)

    def record(self) -> dict[str, Any]:
        """Return the settings of a run by name, for config.json: a region and a reading only if the run has one."""
        record = asdict(self)
        idle = {name for name in ("region", "reading") if not record[name]}
        return {name: value for name, value in record.items() if name not in idle}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> DataSettings:
        """Return the settings of a run that `record` returned and JSON kept, which has lists for tuples.

        Args:
            record: May lack settings, which have their defaults then, and have other keys. One without a region has
                none, even if its capture has got one since.

        Raises:
            ArgumentError: a value is out of range.
            TypeError: a value has the wrong type.
        """
        known: dict[str, Any] = {"region": ()}
        for name in (one.name for one in fields(cls) if one.name in record):
            known[name] = tuple(record[name]) if isinstance(record[name], list) else record[name]
        return cls(**known)
