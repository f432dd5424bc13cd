"""What can be set when poses are looked for, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.cameras import Camera

BACKGROUNDS = ("auto", "static", "ignore")


@dataclass(frozen=True)
class SfmConfig:
    """Settings of `relight.sfm.find_poses`; the defaults are for a head filmed on a half circle.

    Attributes:
        max_side_px: Frames are looked at with their longer side no longer than this.
        max_features: A frame's most features.
        background: "static" = it stands still with the head, "ignore" = use only what the flash lights (or
            the session's masks), "auto" = find out.
        marker_side_m: Side of printed ArUco or AprilTag markers, metres, when there are any; gives the unit.
        board: ChArUco board as "COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY", e.g.
            "7x10:0.025:0.018:DICT_5X5_250"; gives the unit.
        refine_intrinsics: Refine those of calibration.json too, from where they are.
        min_registered: Least share of the frames that must get a pose; below it the result is refused.
        max_keyframes: More frames than these are thinned out for the mapping and posed afterwards.
        threads: Worker threads; 0 = one for each core.
        seed: Of everything that is drawn at random.
    """

    max_side_px: int = 800
    max_features: int = 2000
    background: str = "auto"
    marker_side_m: float | None = None
    board: str | None = None
    refine_intrinsics: bool = False
    min_registered: float = 0.6
    max_keyframes: int = 240
    threads: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses what cannot be meant."""
        if self.background not in BACKGROUNDS:
            raise ValueError(f"background is {self.background!r}, not one of {', '.join(BACKGROUNDS)}")
        if self.max_side_px < 64 or self.max_features < 50 or self.max_keyframes < 3:
            raise ValueError("max_side_px, max_features and max_keyframes must be at least 64, 50 and 3")
        if self.marker_side_m is not None and not self.marker_side_m > 0:
            raise ValueError(f"marker_side_m is {self.marker_side_m}, not above 0")
        if not 0.0 < self.min_registered <= 1.0:
            raise ValueError(f"min_registered is {self.min_registered}, not a share above 0")


@dataclass(frozen=True, eq=False)
class PoseResult:
    """Poses of a session's frames, in a world of their own.

    The world has +Y up (the mean of the cameras' up), its origin where the cameras look, and +Z level
    towards the middle of their path. Its unit is the metre when `metric`; else the median distance from the
    cameras to the origin is `relight.sfm.world.TYPICAL_DISTANCE`.

    Attributes:
        cameras: By frame index, at the frames' full size, with distortion where one was found.
        points_world: [P, 3] float64 sparse cloud.
        colors: [P, 3] float32 linear radiance 0..1, of unlit frames where they show the point.
        error_px: [P] mean reprojection error, pixels of the full-size frames.
        track_length: [P] number of frames in which a point was found.
        metric: Whether a printed marker or board of known size fixed the unit.
        scale_source: What fixed the unit, in words.
        report: Plain numbers and texts: frames, features, pairs, attempts, errors, seconds.
        warnings: Sentences for the user.
    """

    cameras: dict[int, Camera]
    points_world: NDArray[np.float64]
    colors: NDArray[np.float32] | None
    error_px: NDArray[np.float64]
    track_length: NDArray[np.int64]
    metric: bool
    scale_source: str
    report: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
