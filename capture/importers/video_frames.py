"""The second pass over a video: the chosen frames become pictures, and every frame a line of the log."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import cv2
from av.video.frame import VideoFrame

from capture.errors import SourceError
from capture.images import encode_image
from capture.importers.options import Progress
from capture.importers.recording_parts import Recording
from capture.session import FrameRecord, Session
from capture.video import decode_video
from capture.video.colour import VideoColour, rgb_from_frame

# Huffman coding of averaged differences: three times faster than deflate at its fastest and, on video frames
# with their noise, a fifth smaller.
_FAST_PNG = [
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
]


def write_frames(
    session: Session, recording: Recording, records: Sequence[FrameRecord], progress: Progress
) -> None:
    """Writes the pictures of the records that name one, and all records; what the session has already stays.

    Pictures are encoded by a few threads and written in order; no more than two a thread are in memory.

    Raises:
        SourceError: a file has changed since the first pass.
    """
    present = {record.index for record in session.frames}
    workers = min(4, os.cpu_count() or 1)
    waiting: deque[tuple[FrameRecord, Future[bytes] | None]] = deque()
    encoding = 0

    def write_first() -> int:
        record, picture = waiting.popleft()
        if picture is not None:
            session.write_frame(record.index, picture.result())
        session.append_frame(record)
        progress("writing frames", (record.index + 1) / len(records))
        return picture is not None

    with ThreadPoolExecutor(workers, thread_name_prefix="png") as pool:
        for record, picture, colour in _pictures(recording, records):
            if record.index in present:
                continue
            job = pool.submit(_encode, picture, colour) if picture is not None else None
            waiting.append((record, job))
            encoding += job is not None
            while encoding > 2 * workers or (waiting and waiting[0][1] is None):
                encoding -= write_first()
        while waiting:
            write_first()


def _pictures(
    recording: Recording, records: Sequence[FrameRecord]
) -> Iterator[tuple[FrameRecord, VideoFrame | None, VideoColour]]:
    """Every record with its decoded picture, None where none is to be kept."""
    index = 0
    for part in recording.parts:
        for frame in decode_video(part.video):
            if index >= len(records):
                break
            record = records[index]
            yield record, frame.picture if record.file is not None else None, part.video.colour
            index += 1
    if index != len(records):
        raise SourceError(
            f"{recording.parts[-1].video.path} changed while it was read: it had {len(records)} frames and "
            f"now has {index}; import it again when nothing writes to it."
        )


def _encode(picture: VideoFrame, colour: VideoColour) -> bytes:
    return encode_image(rgb_from_frame(picture, colour), ".png", _FAST_PNG)
