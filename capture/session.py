"""The session folder: the one contract between capture and fit.

    SESSION/
      session.json        schema version, source, device, image, flash schedule, status
      frames.jsonl        one line a frame, appended and synced as it is written
      frames/NNNNNN.png   the pictures, never resampled, in the sensor's orientation
      calibration.json    what is known of this camera and flash (optional)
      scene/              derived: cameras (COLMAP text model), points.ply, masks/
      portraits/NAME/     what was fitted

Order of writing: a frame's picture is whole and on the disk before its line is; the line is on the disk before `append_frame`
returns. So a power cut costs at most the frame in hand. A torn last line is left out on reading, and moved to frames.torn
before the next line is appended.
"""

from __future__ import annotations

import json
import logging
import math
import numbers
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from capture.atomic import atomic_write, sync
from capture.cameras import LARGEST_SIDE, Camera
from capture.colmap_model import read_colmap_model, write_colmap_model
from capture.errors import ImageError, SessionError, TransferError
from capture.images import read_image, write_image
from capture.json_fields import Fields, parse_json, read_json
from capture.response import Response, load_response
from capture.transfer import canonical_transfer

try:
    import fcntl
except ImportError:  # Windows: a second writer goes unnoticed there
    fcntl = None  # type: ignore[assignment]

logger = logging.getLogger(__name__)

SCHEMA = "relight-session"
SCHEMA_VERSION = 1
STATUSES = ("recording", "complete", "interrupted")

#: Reasons that keep a frame from being fitted; other reasons are remarks.
EXCLUDING_REASONS = frozenset(
    {"partial_flash", "clipped_frame", "blurred", "drift", "not_selected", "unreadable", "missing_file"}
)

_LONGEST_LINE = 1 << 20


@dataclass(frozen=True, kw_only=True)
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
        for name, low, high in (
            ("index", 0, 10**9),
            ("width", 1, LARGEST_SIDE),
            ("height", 1, LARGEST_SIDE),
            ("flash", 0, 1),
        ):
            value = getattr(self, name)
            if value is None and name != "flash":
                raise ValueError(f"{name} is missing")
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} is {value}, not in {low}..{high}")
        if not isinstance(self.reasons, tuple | list) or not all(
            isinstance(reason, str) for reason in self.reasons
        ):
            raise ValueError(f"reasons must be texts, not {self.reasons!r}")
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
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} is {value}, not a finite number")
        object.__setattr__(self, name, value)

    @property
    def usable(self) -> bool:
        """Whether the frame may be fitted or measured: kept, with a known flash, and not excluded."""
        return self.file is not None and self.flash is not None and EXCLUDING_REASONS.isdisjoint(self.reasons)

    def to_json(self) -> str:
        """One line without its newline; what is unknown is left out, except `file` and `flash`, which are written as null."""
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


class Session:
    """A session folder, opened for reading and, from the first append on, for writing.

    Make one with `create` or `open`. As a context manager it is finished on leaving when something was written: as
    "complete", or as "interrupted" when an exception passes.

    Attributes:
        path: the folder.
        status: "recording", "complete" or "interrupted".
        info: the other entries of session.json: source, device, image (width, height, transfer, rotation_deg),
            flash_schedule, ...; change them with `update_info`.
        frames: records in the order of the log.
        repairs: what was wrong with the folder and how it is read nevertheless, one sentence each.
    """

    def __init__(self, path: Path, status: str, info: dict[str, Any]) -> None:
        """For `create` and `open` only."""
        self.path = path
        self.status = status
        self.info = info
        self.frames: list[FrameRecord] = []
        self.repairs: list[str] = []
        self._by_index: dict[int, FrameRecord] = {}
        self._files: set[str] = set()
        self._log: BinaryIO | None = None
        self._log_size = 0  # bytes of the log that are understood
        self._log_ends_open = False  # the last line is whole but has no newline
        self._response: Response | None = None

    # ---------------------------------------------------------------- making and opening

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        source: Mapping[str, Any],
        width: int,
        height: int,
        transfer: str = "srgb",
        rotation_deg: int = 0,
        device: Mapping[str, Any] | None = None,
        flash_schedule: Mapping[str, Any] | None = None,
    ) -> Session:
        """Makes a new session folder, which must not exist or be empty.

        Args:
            path: the folder.
            source: where the frames come from, at least {"kind": ...}.
            width: of the frames, pixels, sensor orientation.
            height: pixels.
            transfer: name of the frames' transfer function.
            rotation_deg: 0, 90, 180 or 270: clockwise rotation that shows the frames upright.
            device: the camera and its locked controls.
            flash_schedule: what the flash was asked to do.
        """
        path = Path(path)
        if rotation_deg not in (0, 90, 180, 270):
            raise ValueError(f"rotation_deg is {rotation_deg}, not 0, 90, 180 or 270")
        try:
            if path.is_dir() and any(path.iterdir()):
                hint = "open it to go on" if (path / "session.json").is_file() else "name another folder"
                raise SessionError(f"{path} exists already and is not empty; {hint}.")
            (path / "frames").mkdir(parents=True, exist_ok=True)
            atomic_write(path / "frames.jsonl", b"")
            info = {
                "created": datetime.now(UTC).isoformat(timespec="seconds"),
                "source": dict(source),
                "device": dict(device) if device is not None else None,
                "image": {
                    "width": int(width),
                    "height": int(height),
                    "transfer": canonical_transfer(transfer),
                    "rotation_deg": int(rotation_deg),
                },
                "flash_schedule": dict(flash_schedule) if flash_schedule is not None else None,
            }
            session = cls(path, "recording", info)
            session._open_log()
            session._write_manifest()
        except OSError as cause:
            raise SessionError(f"The session {path} cannot be made: {cause.strerror or cause}.") from cause
        return session

    @classmethod
    def open(cls, path: Path) -> Session:
        """Opens a session for reading; appending to it resumes it.

        A torn last line, a missing picture and a recording that was never closed are repaired in memory and named in
        `repairs`; nothing on the disk is changed.

        Raises:
            SessionError: no session, of an unknown or newer schema, or damaged elsewhere.
        """
        path = Path(path)
        if not (path / "session.json").is_file():
            raise SessionError(
                f"{path} is no session (it has no session.json); make one with `relight import`."
            )
        manifest = read_json(path / "session.json", SessionError)
        session = cls(path, _checked_status(manifest), _checked_info(manifest))
        try:
            session._read_log()
            if session.status == "recording" and not session._is_being_written():
                session.status = "interrupted"
                session._repaired("The recording was never closed; it is read as interrupted.")
        except OSError as cause:
            raise SessionError(f"{path}: frames.jsonl cannot be read: {cause.strerror or cause}.") from cause
        return session

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._log is not None:
            self.finish("complete" if error is None else "interrupted")

    # ---------------------------------------------------------------- writing

    def write_frame(self, index: int, image: NDArray[Any] | bytes, suffix: str = ".png") -> str:
        """Puts a frame's picture into the session, to be followed by `append_frame`.

        Args:
            index: the frame's number.
            image: [H, W, 3] RGB or [H, W] pixels, or the content of a picture file, which is stored byte for byte.
            suffix: format of the file, with its dot.

        Returns:
            The file's name relative to the session.
        """
        if index in self._by_index:
            raise SessionError(
                f"{self.path} has a frame {index} already; a frame's picture is never overwritten."
            )
        file = f"frames/{index:06d}{suffix}"
        try:
            if isinstance(image, bytes):
                atomic_write(self.path / file, image)
            else:
                write_image(self.path / file, image)
        except OSError as cause:
            raise SessionError(f"{self.path / file} cannot be written: {cause.strerror or cause}.") from cause
        return file

    def append_frame(self, record: FrameRecord) -> None:
        """Adds a frame's line to the log; it is on the disk when this returns."""
        if complaint := self._complaint(record):
            raise SessionError(f"{self.path}: {complaint}.")
        if record.file is not None and not (self.path / record.file).is_file():
            raise SessionError(f"{self.path}: write {record.file} before its line.")
        line = record.to_json().encode() + b"\n"
        try:
            log = self._open_log()
            self._append(log, line)
        except OSError as cause:
            raise SessionError(
                f"{self.path}: frame {record.index} cannot be logged: {cause.strerror or cause}; the frames before it are safe."
            ) from cause
        self._remember(record)

    def replace_frames(self, records: list[FrameRecord]) -> None:
        """Exchanges the whole log for one with the same frames in one step, as when frames are tagged after the capture."""
        if sorted(record.index for record in records) != sorted(self._by_index):
            raise SessionError(f"{self.path}: the log can only be replaced by one of the same frames.")
        content = b"".join(record.to_json().encode() + b"\n" for record in records)
        try:
            was_open = self._log is not None
            self._open_log()
            self._close_log()
            atomic_write(self.path / "frames.jsonl", content)
            self._log_size = len(content)
            if was_open:
                self._open_log()
        except OSError as cause:
            raise SessionError(
                f"{self.path}: the log cannot be replaced: {cause.strerror or cause}."
            ) from cause
        self.frames = list(records)
        self._by_index = {record.index: record for record in records}

    def update_info(self, **entries: Any) -> None:
        """Sets entries of session.json, such as a report of the tagging, and writes it."""
        if reserved := entries.keys() & {"schema", "version", "status"}:
            raise ValueError(f"{sorted(reserved)[0]} is not an entry to set")
        self.info.update(entries)
        self._write_manifest()

    def finish(self, status: str = "complete") -> None:
        """Closes the log and records how the capture ended."""
        if status not in STATUSES:
            raise ValueError(f"status is {status!r}, not one of {', '.join(STATUSES)}")
        self._close_log()
        self.status = status
        self._write_manifest()

    # ---------------------------------------------------------------- reading

    def load_image(self, record: FrameRecord) -> NDArray[Any]:
        """A frame's picture as stored: [H, W, 3] RGB or [H, W].

        Raises:
            SessionError: not kept, missing, damaged or of another size than its record.
        """
        if record.file is None:
            raise SessionError(
                f"{self.path}: frame {record.index} was looked at but not kept; it has no picture."
            )
        try:
            image = read_image(self.path / record.file)
        except ImageError as cause:
            raise SessionError(f"Frame {record.index}: {cause}") from cause
        height, width = image.shape[:2]
        if (width, height) != (record.width, record.height):
            raise SessionError(
                f"{self.path}: frame {record.index} ({record.file}) is {width} x {height} pixels, its record says "
                f"{record.width} x {record.height}; put the original picture back."
            )
        return image

    def load_radiance(self, record: FrameRecord) -> NDArray[np.float32]:
        """A frame in linear radiance: [H, W, 3], 1.0 = white clip.

        Integer pixels go through the response of calibration.json where there is one, else through the session's transfer
        function. Float pixels (EXR, HDR) are radiance already.
        """
        image = self.load_image(record)
        if image.ndim == 2:
            image = np.repeat(image[..., None], 3, axis=2)
        if image.dtype == np.float32:
            return np.asarray(image, dtype=np.float32)
        if self._response is None:
            self._response = load_response(self.calibration_path) or Response(self.info["image"]["transfer"])
        return self._response.to_linear(image)

    def load_mask(self, record: FrameRecord) -> NDArray[np.uint8] | None:
        """The subject's coverage in a frame: [H, W] 0..255; None where there is no mask."""
        path = self.mask_path(record.index)
        if not path.is_file():
            return None
        mask = read_image(path)
        if mask.dtype != np.uint8 or mask.shape[:2] != (record.height, record.width):
            raise SessionError(f"{path} must be an 8-bit mask of {record.width} x {record.height} pixels.")
        return mask if mask.ndim == 2 else np.ascontiguousarray(mask[..., 0])

    # ---------------------------------------------------------------- places

    @property
    def calibration_path(self) -> Path:
        """calibration.json, which need not exist."""
        return self.path / "calibration.json"

    @property
    def scene_dir(self) -> Path:
        """What is derived from the frames."""
        return self.path / "scene"

    @property
    def cameras_dir(self) -> Path:
        """The poses, as a COLMAP text model."""
        return self.scene_dir / "cameras"

    @property
    def points_path(self) -> Path:
        """The point cloud."""
        return self.scene_dir / "points.ply"

    @property
    def masks_dir(self) -> Path:
        """Masks by frame index."""
        return self.scene_dir / "masks"

    def mask_path(self, index: int) -> Path:
        """Where a frame's mask is or would be."""
        return self.masks_dir / f"{index:06d}.png"

    @property
    def portraits_dir(self) -> Path:
        """What was fitted."""
        return self.path / "portraits"

    def save_scene_cameras(self, cameras: Mapping[int, Camera]) -> None:
        """Writes poses by frame index; every index must be a kept frame."""
        named = {}
        for index, camera in cameras.items():
            record = self._by_index.get(index)
            if record is None or record.file is None:
                raise SessionError(f"{self.path} has no kept frame {index} for which to save a camera.")
            named[record.file] = camera
        write_colmap_model(self.cameras_dir, named)

    def load_scene_cameras(self) -> dict[int, Camera]:
        """Poses by frame index, with the flash of each frame's record."""
        records = {record.file: record for record in self.frames if record.file is not None}
        cameras = {}
        for name, camera in read_colmap_model(self.cameras_dir).cameras.items():
            record = records.get(name)
            if record is None:
                raise SessionError(
                    f"{self.cameras_dir} has a pose for {name!r}, which is no frame of the session; rebuild it."
                )
            if (camera.width, camera.height) != (record.width, record.height):
                raise SessionError(
                    f"{self.cameras_dir}: the camera of {name} is {camera.width} x {camera.height} pixels, the frame "
                    f"{record.width} x {record.height}; rebuild it."
                )
            cameras[record.index] = replace(camera, flash=record.flash)
        return cameras

    # ---------------------------------------------------------------- the log and the manifest

    def _read_log(self) -> None:
        log_path = self.path / "frames.jsonl"
        if not log_path.is_file():
            raise SessionError(
                f"{self.path} has lost its frames.jsonl; restore it from a copy of the session."
            )
        with log_path.open("rb") as log:
            number = 0
            while line := log.readline(_LONGEST_LINE):
                number += 1
                whole = line.endswith(b"\n")
                try:
                    record = FrameRecord.from_json(line)
                except ValueError as cause:
                    if not whole and len(line) < _LONGEST_LINE:
                        self._repaired(
                            f"Line {number} of frames.jsonl was torn while it was written; it is left out."
                        )
                        return
                    raise SessionError(f"{log_path}, line {number}: {cause}.") from cause
                if complaint := self._complaint(record):
                    raise SessionError(f"{log_path}, line {number}: {complaint}.")
                self._remember(self._with_file_checked(record))
                self._log_size += len(line)
                self._log_ends_open = not whole

    def _complaint(self, record: FrameRecord) -> str | None:
        if record.index in self._by_index:
            return f"the frame {record.index} is there already"
        if record.file in self._files:
            return f"the file {record.file} belongs to another frame"
        return None

    def _with_file_checked(self, record: FrameRecord) -> FrameRecord:
        if record.file is None or (self.path / record.file).is_file():
            return record
        self._repaired(
            f"The picture {record.file} of frame {record.index} is missing; the frame is not used."
        )
        return replace(record, reasons=(*record.reasons, "missing_file"))

    def _remember(self, record: FrameRecord) -> None:
        self.frames.append(record)
        self._by_index[record.index] = record
        if record.file is not None:
            self._files.add(record.file)

    def _repaired(self, sentence: str) -> None:
        self.repairs.append(sentence)
        logger.warning("%s: %s", self.path, sentence)

    def _open_log(self) -> BinaryIO:
        """The log, open for appending at the end of what is understood, and locked against other writers."""
        if self._log is not None:
            return self._log
        log = (self.path / "frames.jsonl").open("r+b", buffering=0)
        try:
            if not _lock(log):
                raise SessionError(
                    f"{self.path} is being recorded by another process; wait for it to finish."
                )
            size = log.seek(0, os.SEEK_END)
            if size > self._log_size:
                self._move_torn_line_aside(log)
            if self._log_ends_open:
                self._append(log, b"\n")
                self._log_ends_open = False
        except BaseException:
            log.close()
            raise
        self._log = log
        if self.status != "recording":
            self.status = "recording"
            self._write_manifest()
        return log

    def _move_torn_line_aside(self, log: BinaryIO) -> None:
        log.seek(self._log_size)
        torn = log.read(_LONGEST_LINE)
        if torn.endswith(b"\n"):
            raise SessionError(f"{self.path} has grown since it was opened; open it again to go on.")
        aside = self.path / "frames.torn"
        with aside.open("ab") as file:
            file.write(torn + b"\n")
        sync(aside)
        log.truncate(self._log_size)

    def _append(self, log: BinaryIO, data: bytes) -> None:
        """Writes at the end of the log; after a failure (disk full) the log is as before."""
        log.seek(self._log_size)
        try:
            if log.write(data) != len(data):
                raise OSError("the disk is full")
            os.fsync(log.fileno())
        except OSError:
            log.truncate(self._log_size)
            raise
        self._log_size += len(data)

    def _close_log(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None

    def _is_being_written(self) -> bool:
        with (self.path / "frames.jsonl").open("rb") as log:
            return not _lock(log)

    def _write_manifest(self) -> None:
        manifest = {"schema": SCHEMA, "version": SCHEMA_VERSION, "status": self.status, **self.info}
        try:
            content = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
        except (TypeError, ValueError) as cause:
            raise SessionError(f"{self.path}: session.json cannot hold these entries: {cause}.") from cause
        try:
            atomic_write(self.path / "session.json", content.encode() + b"\n")
        except OSError as cause:
            raise SessionError(
                f"{self.path}: session.json cannot be written: {cause.strerror or cause}."
            ) from cause


def _lock(log: BinaryIO) -> bool:
    """Takes the log for the one writer, until it is closed; False = another one has it."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(log.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_inside(file: str) -> bool:
    path = PurePosixPath(file)
    return (
        bool(file)
        and not path.is_absolute()
        and ".." not in path.parts
        and "\\" not in file
        and "\0" not in file
    )


def _checked_status(manifest: Fields) -> str:
    """Status of a manifest whose schema is ours."""
    schema = manifest.text("schema", "")
    if schema != SCHEMA:
        raise manifest.fail(f"the schema is {schema!r}, not {SCHEMA!r}; this is no session of this program.")
    version = manifest.integer("version", low=1)
    if version > SCHEMA_VERSION:
        raise manifest.fail(
            f"it was written by a newer program (schema version {version}, this one knows {SCHEMA_VERSION}); update the program."
        )
    status: str = manifest.text("status")
    if status not in STATUSES:
        raise manifest.fail(f"the status is {status!r}, not one of {', '.join(STATUSES)}.")
    return status


def _checked_info(manifest: Fields) -> dict[str, Any]:
    """The other entries of a manifest."""
    manifest.child("source")
    image = manifest.child("image")
    rotation = image.integer("rotation_deg", 0)
    if rotation not in (0, 90, 180, 270):
        raise image.fail(f'"rotation_deg" is {rotation}, not 0, 90, 180 or 270.')
    try:
        transfer = canonical_transfer(image.text("transfer"))
    except TransferError as cause:
        raise image.fail(str(cause)) from cause
    info = {
        key: value for key, value in manifest.values.items() if key not in ("schema", "version", "status")
    }
    info["image"] = {
        **image.values,
        "width": image.integer("width", low=1, high=LARGEST_SIDE),
        "height": image.integer("height", low=1, high=LARGEST_SIDE),
        "transfer": transfer,
        "rotation_deg": rotation,
    }
    return info
