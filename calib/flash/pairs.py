"""Pictures of a board in pairs, with and without the flash, in linear light.

From a session: the sharpest frame of every pulse (frames that follow each other, all lit), with the unlit
frame nearest in time. From a folder: files whose names are the same but for `_flash` and `_noflash` at their
end, or that are the same in two folders `flash` and `noflash`; their order by name is that of the pulses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration
from calib.errors import FlashGeometryError
from capture.controls import UNKNOWN, Controls
from capture.errors import SourceError
from capture.frame_record import FrameRecord
from capture.images import IMAGE_SUFFIXES, read_image
from capture.response import Response
from capture.session import Session

# Beyond this the frames are not of one scene any more, and beyond that they are not equally exposed.
_LONGEST_GAP_S = 1.0
_LARGEST_EXPOSURE_RATIO = 1.02
# Stored values from here on are clipped: noise leaves none below it, and curves are steep there.
_CLIPPED = 0.98
_BETWEEN_PULSES = 0.05  # s: lit frames farther apart, with unlit ones between or not, are of two pulses


@dataclass(frozen=True, eq=False)
class LinearPicture:
    """One picture.

    Attributes:
        name: for people.
        stored: [H, W, 3] as stored.
        radiance: [H, W, 3] float32, linear, dark level taken off.
        clipped: [H, W] where a channel is at its limit.
    """

    name: str
    stored: NDArray[Any]
    radiance: NDArray[np.float32]
    clipped: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FlashPair:
    """One pulse: `lit` with it, `unlit` without; `time_s` of the pulse, or its number where none is known."""

    lit: LinearPicture
    unlit: LinearPicture
    time_s: float


@dataclass(frozen=True, eq=False)
class PairSource:
    """Where pairs come from.

    Attributes:
        count: number of pairs.
        timed: whether `time_s` are seconds; otherwise numbers of pulses.
        transfer: what the pictures were linearised by, for people.
        pairs: reads them one at a time, in order of time.
        left_out: what could not be paired, one clause each.
        controls: settings of the camera, as far as they are known.
    """

    count: int
    timed: bool
    transfer: str
    pairs: Callable[[], Iterator[FlashPair]]
    left_out: list[str]
    controls: Controls = UNKNOWN


def open_pairs(source: Path, calibration: Calibration, transfer: str = "srgb") -> PairSource:
    """The pairs of a session or a folder.

    Args:
        source: the session or folder.
        calibration: its response and dark level are used.
        transfer: of a folder's pictures, where the calibration has no response.

    Raises:
        FlashGeometryError: no pairs in it.
        SessionError, SourceError: it cannot be read.
    """
    source = Path(source)
    if (source / "session.json").is_file():
        return _session_pairs(source, calibration)
    if source.is_dir():
        return _folder_pairs(source, calibration, transfer)
    raise SourceError(
        f"{source} is no session and no folder; give the session in which the board was filmed with the "
        "flash blinking, or a folder with pictures NAME_flash and NAME_noflash."
    )


def pulses_of(records: list[FrameRecord]) -> tuple[list[tuple[FrameRecord, FrameRecord]], int]:
    """The lit and unlit frame of each pulse, in order of time, and the number of pulses without an unlit."""
    usable = [record for record in records if record.usable]
    usable.sort(key=lambda record: (_time(record), record.index))
    unlit = [record for record in usable if record.flash == 0]
    if not unlit:
        return [], 0
    times = np.array([_time(record) for record in unlit])
    pulses: list[list[FrameRecord]] = []
    before: FrameRecord | None = None
    for record in usable:
        if record.flash == 1:
            near = before is not None and before.flash == 1
            if near and before is not None and _time(record) - _time(before) < 2 * _BETWEEN_PULSES:
                pulses[-1].append(record)
            else:
                pulses.append([record])
        before = record
    pairs = []
    for pulse in pulses:
        lit = max(pulse, key=lambda record: record.sharpness or 0.0)
        gaps = np.abs(times - _time(lit))
        for nearest in np.argsort(gaps, kind="stable")[:3]:
            if gaps[nearest] <= _LONGEST_GAP_S and _equally_exposed(lit, unlit[int(nearest)]):
                pairs.append((lit, unlit[int(nearest)]))
                break
    return pairs, len(pulses) - len(pairs)


def _session_pairs(path: Path, calibration: Calibration) -> PairSource:
    session = Session.open(path)
    lit = sum(1 for record in session.frames if record.usable and record.flash == 1)
    unlit = sum(1 for record in session.frames if record.usable and record.flash == 0)
    if not lit or not unlit:
        raise FlashGeometryError(
            f"{path} has {lit} usable frames with the flash and {unlit} without; both are needed: film the "
            "board with the flash blinking, and import or capture it so that its frames are tagged."
        )
    pairs, alone = pulses_of(session.frames)
    if not pairs:
        raise FlashGeometryError(
            f"No frame of {path} with the flash has an equally exposed one without within "
            f"{_LONGEST_GAP_S:g} s; lock exposure and gain, and let the flash blink."
        )
    response = calibration.response or Response(session.info["image"]["transfer"])
    limit = float(session.info["image"].get("clip_radiance", np.inf))
    dark = calibration.value("dark")
    timed = all(record.pts_s is not None for record, _ in pairs)

    def picture(record: FrameRecord) -> LinearPicture:
        return linear_picture(f"frame {record.index}", session.load_image(record), response, dark, limit)

    def read() -> Iterator[FlashPair]:
        for number, (with_flash, without) in enumerate(pairs):
            at_s = _time(with_flash) if timed else float(number)
            yield FlashPair(picture(with_flash), picture(without), at_s)

    lost = [f"{alone} pulses have no unlit frame that is near in time and equally exposed"] if alone else []
    by = response.transfer or "the measured response"
    return PairSource(len(pairs), timed, by, read, lost, session.controls)


def _folder_pairs(folder: Path, calibration: Calibration, transfer: str) -> PairSource:
    lit, unlit = _named(folder, "flash"), _named(folder, "noflash")
    names = sorted(lit.keys() & unlit.keys())
    if not names:
        raise FlashGeometryError(
            f"{folder} holds no pairs ({len(lit)} pictures are named as with the flash, {len(unlit)} as "
            "without); name them NAME_flash and NAME_noflash, or put them into folders flash and noflash "
            "under the same names."
        )
    response = calibration.response or Response(transfer)
    dark = calibration.value("dark")

    def picture(path: Path) -> LinearPicture:
        return linear_picture(path.name, read_image(path), response, dark, np.inf)

    def read() -> Iterator[FlashPair]:
        for number, name in enumerate(names):
            yield FlashPair(picture(lit[name]), picture(unlit[name]), float(number))

    alone = sorted(lit.keys() ^ unlit.keys())
    lost = [f"{len(alone)} pictures have no partner, such as {alone[0]}"] if alone else []
    return PairSource(len(names), False, response.transfer or "the measured response", read, lost)


def _named(folder: Path, kind: str) -> dict[str, Path]:
    """Name of a pair -> its picture of a kind."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in IMAGE_SUFFIXES and path.stem.endswith(f"_{kind}"):
            found[path.stem[: -len(kind) - 1]] = path
    if (folder / kind).is_dir():
        for path in sorted((folder / kind).iterdir()):
            if path.suffix.lower() in IMAGE_SUFFIXES:
                found[path.stem] = path
    return found


def linear_picture(
    name: str, image: NDArray[Any], response: Response, dark: NDArray[np.float64] | None, limit: float
) -> LinearPicture:
    """A picture in linear light.

    Args:
        name: for people.
        image: as stored.
        response: stored value above the dark level -> radiance; float pictures are radiance already.
        dark: [3] stored dark level; None = 0.
        limit: of float pictures, from which on they are clipped.
    """
    stored: NDArray[Any] = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    clipped: NDArray[np.bool_]
    if stored.dtype == np.float32:
        bad = ~np.isfinite(stored) | (stored >= _CLIPPED * limit)
        clipped = np.any(bad, axis=2)
        return LinearPicture(name, stored, np.where(bad, np.float32(0), stored), clipped)
    largest = np.iinfo(stored.dtype).max
    clipped = np.any(stored >= _CLIPPED * largest, axis=2)
    if dark is None or not dark.any():
        return LinearPicture(name, stored, response.to_linear(stored), clipped)
    # Noise below the dark level stays negative: cut off, it would leave light in a dark room.
    above = stored / largest - dark
    radiance = np.copysign(response.to_linear(np.abs(above)), above).astype(np.float32)
    return LinearPicture(name, stored, radiance, clipped)


def _equally_exposed(first: FrameRecord, second: FrameRecord) -> bool:
    """As far as it is known."""
    for name in ("exposure_s", "gain"):
        one, other = getattr(first, name), getattr(second, name)
        if one and other and max(one / other, other / one) > _LARGEST_EXPOSURE_RATIO:
            return False
    return True


def _time(record: FrameRecord) -> float:
    """Seconds; where none are known, frames are taken for thirty a second."""
    return record.pts_s if record.pts_s is not None else record.index / 30.0
