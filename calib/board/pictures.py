"""Grey pictures of a board from videos, folders of stills and sessions, one at a time, all of one size.

Of a video, the stillest sharp frame of each short interval is taken: a board that moves while the rows are
read out is sheared, and what a hand holds stands still now and then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import IntrinsicsError
from capture.errors import SourceError
from capture.images import IMAGE_SUFFIXES, read_image
from capture.selection import measure_sharpness
from capture.session import Session
from capture.video.colour import bit_depth, plane
from capture.video.reader import decode_video, probe_video

# Every frame of a video is looked at, and one of each interval is searched for the board, which takes longer.
_INTERVAL_S = 0.2
_LOOKED_AT_SIDE = 480
# Of the frames that are nearly as sharp as the sharpest, the stillest is taken. Sharpness goes with the
# square
# of the contrast of fine detail.
_NEARLY_AS_SHARP = 0.6


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture to be searched.

    Attributes:
        name: for people: the file, or the file and the time in it.
        grey: [H, W] as stored (not linear), in sensor orientation.
        fraction: how far through all sources it is, 0..1.
    """

    name: str
    grey: NDArray[np.uint8]
    fraction: float


def board_pictures(sources: Sequence[Path]) -> Iterator[Picture]:
    """All pictures of the sources in turn.

    Args:
        sources: videos, folders of pictures, pictures, or sessions.

    Raises:
        SourceError, ImageError, SessionError: a source cannot be read.
        IntrinsicsError: the pictures are not all of one size.
    """
    first: Picture | None = None
    for number, source in enumerate(sources):
        for picture in _pictures_of(Path(source)):
            if first is None:
                first = picture
            if picture.grey.shape != first.grey.shape:
                raise IntrinsicsError(
                    f"{first.name} is {_size(first.grey)} pixels and {picture.name} is "
                    f"{_size(picture.grey)}; "
                    "a calibration holds for one picture size: use pictures of one recording mode, in one "
                    "orientation, not cropped."
                )
            yield Picture(picture.name, picture.grey, (number + picture.fraction) / len(sources))


def _pictures_of(source: Path) -> Iterator[Picture]:
    if (source / "session.json").is_file():
        yield from _session_pictures(source)
    elif source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise SourceError(
                f"{source} holds no picture ({', '.join(sorted(IMAGE_SUFFIXES))}); give the folder with the "
                "stills of the board."
            )
        for number, path in enumerate(files, start=1):
            yield Picture(path.name, _grey(read_image(path)), number / len(files))
    elif source.suffix.lower() in IMAGE_SUFFIXES:
        yield Picture(source.name, _grey(read_image(source)), 1.0)
    else:
        yield from _video_pictures(source)


def _session_pictures(path: Path) -> Iterator[Picture]:
    session = Session.open(path)
    records = [record for record in session.frames if record.file is not None]
    if not records:
        raise SourceError(f"{path} holds no pictures; give a session that was recorded of the board.")
    for number, record in enumerate(records, start=1):
        yield Picture(f"frame {record.index}", _grey(session.load_image(record)), number / len(records))


def _video_pictures(path: Path) -> Iterator[Picture]:
    info = probe_video(path)
    best: Picture | None = None
    best_sharpness = best_motion = 0.0
    interval = -1
    before: NDArray[np.uint8] | None = None
    for frame in decode_video(info):
        luma = plane(frame.picture, 0)
        grey = luma if luma.dtype == np.uint8 else _eight_bits(luma, bit_depth(frame.picture))
        factor = min(1.0, _LOOKED_AT_SIDE / max(grey.shape))
        small = np.asarray(
            cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
        motion = np.inf if before is None else float(cv2.norm(small, before, cv2.NORM_L1)) / small.size
        before = small
        at_s = frame.pts_s - info.start_s
        if (now := int(at_s / _INTERVAL_S)) != interval:
            if best is not None:
                yield best
            best, interval = None, now
        if frame.damaged:
            continue
        sharpness = measure_sharpness(small)
        if best is not None:
            stiller = motion < best_motion and sharpness >= _NEARLY_AS_SHARP * best_sharpness
            if not stiller and _NEARLY_AS_SHARP * sharpness < best_sharpness:
                continue
        fraction = min(at_s / info.duration_s, 1.0) if info.duration_s > 0 else 0.0
        best = Picture(f"{path.name} at {at_s:.2f} s", np.array(grey), fraction)
        best_sharpness, best_motion = sharpness, motion
    if best is not None:
        yield best


def _grey(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """[H, W] of 8 bits, of a picture as stored; float ones are linear and get a display's curve."""
    pixels = np.asarray(image)
    if pixels.dtype == np.float32:
        pixels = np.rint(255 * np.clip(pixels, 0.0, 1.0) ** (1 / 2.2)).astype(np.uint8)
    elif pixels.dtype == np.uint16:
        pixels = _eight_bits(pixels, 16)
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.ndim == 3 else pixels
    return np.ascontiguousarray(grey, dtype=np.uint8)


def _eight_bits(values: NDArray[np.generic], bits: int) -> NDArray[np.uint8]:
    """The upper 8 of a number of bits."""
    return np.right_shift(np.asarray(values, dtype=np.uint16), bits - 8).astype(np.uint8)


def _size(grey: NDArray[np.uint8]) -> str:
    return f"{grey.shape[1]} x {grey.shape[0]}"
