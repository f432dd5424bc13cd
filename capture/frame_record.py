"""A frame's line in the session's log: what is known of it, and whether it may be used."""

from __future__ import annotations

import json
import math
import numbers
from dataclasses import dataclass, fields
from pathlib import PurePosixPath

from capture.cameras import LARGEST_SIDE
from capture.json_fields import is_plain_text, parse_json

#: Reasons that keep a frame from being fitted; other reasons are remarks.
EXCLUDING_REASONS = frozenset(
    {"partial_flash", "clipped_frame", "blurred", "drift", "not_selected", "unreadable", "missing_file"}
)

_LARGEST_INDEX = 10**9


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameRecord:
    """One line of frames.jsonl: what is known of a frame that was looked at.

    Attributes:
        index: the frame's number in its source, unique in the session.
        file: its picture, relative to the session with forward slashes; None = looked at but not kept.
        width: pixels.
        height: pixels.
        pts_s: presentation time in the source, seconds.
        device_timestamp_ns: the camera's own clock.
        sequence: the camera's frame counter.
        exposure_s: exposure time.
        gain: sensor gain, 1 = none.
        flash: 1 = lit in every row, 0 = lit in none, None = partial or unknown.
        lit_fraction: share of the frame that the flash lit, 0..1.
        confidence: of `flash`, 0..1.
        reasons: remarks, and why a frame is left out (see EXCLUDING_REASONS).
        split: "train", "val" or None.
        sharpness: larger is sharper; comparable within one session only.
        source: name of the picture that this frame was imported from.
    """

    index: int
    file: str | None
    width: int
    height: int
    pts_s: float | None = None
    device_timestamp_ns: int | None = None
    sequence: int | None = None
    exposure_s: float | None = None
    gain: float | None = None
    flash: int | None = None
    lit_fraction: float | None = None
    confidence: float | None = None
    reasons: tuple[str, ...] = ()
    split: str | None = None
    sharpness: float | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        """Checks every field and turns numpy scalars into Python's.

        Raises:
            ValueError: a value of the wrong kind or out of range.
        """
        for name in ("index", "width", "height", "device_timestamp_ns", "sequence", "flash"):
            self._normalise(name, numbers.Integral, int)
        for name in ("pts_s", "exposure_s", "gain", "lit_fraction", "confidence", "sharpness"):
            self._normalise(name, numbers.Real, float)
        for name in ("file", "split", "source"):
            self._normalise(name, str, str)
        self._check_range("index", 0, _LARGEST_INDEX)
        self._check_range("width", 1, LARGEST_SIDE)
        self._check_range("height", 1, LARGEST_SIDE)
        if self.flash is not None:
            self._check_range("flash", 0, 1)
        if not isinstance(self.reasons, tuple | list) or not all(map(_is_reason, self.reasons)):
            raise ValueError(f"reasons must be plain texts, not {self.reasons!r}")
        object.__setattr__(self, "reasons", tuple(self.reasons))
        if self.split not in (None, "train", "val"):
            raise ValueError(f'split is {self.split!r}, not "train", "val" or null')
        if self.file is not None and not _is_inside(self.file):
            raise ValueError(f"file is {self.file!r}, not a path inside the session")

    def _normalise(self, name: str, kind: type, convert: type) -> None:
        value = getattr(self, name)
        if value is None:
            return
        if not isinstance(value, kind):
            raise ValueError(f"{name} is {value!r}, which is no {kind.__name__.lower()} value")
        value = convert(value)
        if isinstance(value, str) and not is_plain_text(value):
            raise ValueError(f"{name} is {value!r}, which is no plain text")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} is {value}, not a finite number")
        object.__setattr__(self, name, value)

    def _check_range(self, name: str, low: int, high: int) -> None:
        value = getattr(self, name)
        if value is None or not low <= value <= high:
            raise ValueError(f"{name} is {value}, not a whole number in {low}..{high}")

    @property
    def usable(self) -> bool:
        """Whether the frame may be fitted or measured: kept, with a known flash, and not excluded."""
        return self.file is not None and self.flash is not None and EXCLUDING_REASONS.isdisjoint(self.reasons)

    def to_json(self) -> str:
        """One line without its newline; unknown values are left out, except `file` and `flash` (null)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        kept = {k: v for k, v in values.items() if k in ("file", "flash") or (v is not None and v != ())}
        return json.dumps(kept, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> FrameRecord:
        """The record of a line.

        Raises:
            ValueError: not JSON, an unknown key, or a value of the wrong kind.
        """
        values = parse_json(line)
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        known = {field.name for field in fields(cls)}
        if unknown := sorted(values.keys() - known):
            raise ValueError(f"the key {unknown[0]!r} is unknown (known: {', '.join(sorted(known))})")
        if missing := {"index", "file", "width", "height"} - values.keys():
            raise ValueError(f"{sorted(missing)[0]} is missing")
        return cls(**values)


def _is_reason(reason: object) -> bool:
    return isinstance(reason, str) and is_plain_text(reason)


def _is_inside(file: str) -> bool:
    path = PurePosixPath(file)
    return bool(file) and not path.is_absolute() and ".." not in path.parts and "\\" not in file
