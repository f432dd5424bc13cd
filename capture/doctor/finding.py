"""One line of the doctor's answer."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Level(StrEnum):
    """How bad it is."""

    GOOD = "good"
    NOTE = "note"
    BAD = "bad"
    SKIPPED = "not looked at"


@dataclass(frozen=True)
class Finding:
    """What was found.

    Attributes:
        topic: "camera", "flash", "disk", ...
        level: How bad it is.
        sentence: What was found, with its number.
        remedy: What to do; empty = nothing.
    """

    topic: str
    level: Level
    sentence: str
    remedy: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)
