"""What the room looks like, beyond its seed."""

from __future__ import annotations

from dataclasses import dataclass

MARKER_PLACES = ("none", "walls", "screen")


@dataclass(frozen=True)
class DecorConfig:
    """What is in the room; the default is furnished and has pictures on papered walls.

    Attributes:
        plain: bare walls, floor and ceiling of one colour, nothing on them; the window is behind the camera.
        markers: printed markers (`capture.sim.markers`): "none", "walls", or "screen" = a folding screen
            behind the head.
        marker_side_m: side of a marker's black square; walls want about 0.15, the screen 0.07.
    """

    plain: bool = False
    markers: str = "none"
    marker_side_m: float = 0.07

    def __post_init__(self) -> None:
        if self.markers not in MARKER_PLACES:
            raise ValueError(f"markers {self.markers!r} must be one of {', '.join(MARKER_PLACES)}")
        if not 0.01 <= self.marker_side_m <= 0.3:
            raise ValueError(f"marker_side_m {self.marker_side_m} must lie in 0.01..0.3 metres")
