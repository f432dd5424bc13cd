"""The session folder: the one contract between capture and fit.

    SESSION/
      session.json        schema version, source, device, image, flash schedule, status
      frames.jsonl        one line a frame, appended and synced as it is written
      frames/NNNNNN.png   the pictures (or .jpg, .exr), never resampled, in the sensor's orientation
      flash.jsonl         the flash's edges as its device reported them, on the frames' time axis (optional)
      calibration.json    what is known of this camera and flash (optional)
      scene/              derived: cameras (COLMAP text model), points.ply, masks/
      portraits/NAME/     what was fitted

Order of writing: a frame's picture is whole and on the disk before its line is, and the line is on the disk
before `append_frame` returns. So a power cut costs at most the frame in hand.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.calibration_file import applicable_entries, read_calibration_entries
from capture.cameras import Camera
from capture.colmap_model import read_colmap_model, write_colmap_model
from capture.controls import Controls, controls_of_session
from capture.errors import CalibrationError, ImageError, SessionError
from capture.frame_log import FrameLog
from capture.frame_record import EXCLUDING_REASONS as EXCLUDING_REASONS
from capture.frame_record import FrameRecord as FrameRecord
from capture.images import read_image, write_image
from capture.json_fields import Fields
from capture.radiometry import Radiometry, radiometry_of
from capture.session_manifest import RESERVED_KEYS, ROTATIONS_DEG, STATUSES, read_manifest, write_manifest
from capture.transfer import canonical_transfer

logger = logging.getLogger(__name__)


class Session:
    """A session folder, opened for reading and, from the first append on, for writing.

    Make one with `create` or `open`. As a context manager it is finished on leaving when something was
    appended: as "complete", or as "interrupted" when an exception passes.

    Attributes:
        path: the folder.
        status: "recording", "complete" or "interrupted".
        info: the other entries of session.json: source, device, image (width, height, transfer,
            rotation_deg), flash_schedule, ...; change them with `update_info`.
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
        self._by_file: dict[str, FrameRecord] = {}
        self._log = FrameLog(path / "frames.jsonl")
        self._radiometry: Radiometry | None = None

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
        if rotation_deg not in ROTATIONS_DEG:
            raise ValueError(f"rotation_deg is {rotation_deg}, not 0, 90, 180 or 270")
        image = {
            "width": int(width),
            "height": int(height),
            "transfer": canonical_transfer(transfer),
            "rotation_deg": int(rotation_deg),
        }
        info = {
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "source": dict(source),
            "device": None if device is None else dict(device),
            "image": image,
            "flash_schedule": None if flash_schedule is None else dict(flash_schedule),
        }
        session = cls(path, "recording", info)
        try:
            if path.is_dir() and any(path.iterdir()):
                raise SessionError(
                    f"{path} exists already and is not empty; name another folder or remove it."
                )
            (path / "frames").mkdir(parents=True, exist_ok=True)
            atomic_write(path / "frames.jsonl", b"")
            session._write_manifest()  # after all else: a folder with a session.json is a whole session
            session._log.open()
        except OSError as cause:
            raise SessionError(f"The session {path} cannot be made: {cause.strerror or cause}.") from cause
        return session

    @classmethod
    def open(cls, path: Path) -> Session:
        """Opens a session for reading; appending to it resumes it.

        A torn last line, a missing picture and a recording that was never closed are repaired in memory and
        named in `repairs`; nothing on the disk is changed.

        Raises:
            SessionError: no session, of an unknown or newer schema, or damaged elsewhere.
        """
        path = Path(path)
        if not (path / "session.json").is_file():
            raise SessionError(
                f"{path} is no session (it has no session.json); make one with `relight import`."
            )
        session = cls(path, *read_manifest(path / "session.json"))
        for number, record in session._log.read():
            if complaint := session._complaint(record):
                raise SessionError(f"{path / 'frames.jsonl'}, line {number}: {complaint}.")
            session._remember(session._with_file_checked(record))
        if session._log.torn_line is not None:
            session._repaired(
                f"Line {session._log.torn_line} of frames.jsonl is torn; that frame is left out."
            )
        if session.status == "recording" and not session._log.is_being_written():
            session.status = "interrupted"
            session._repaired("The recording was never closed; it is read as interrupted.")
        return session

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._log.is_open:
            self.finish("complete" if error is None else "interrupted")

    def write_frame(self, index: int, image: NDArray[Any] | bytes, suffix: str = ".png") -> str:
        """Puts a frame's picture into the session, to be followed by `append_frame`.

        Args:
            index: the frame's number.
            image: [H, W, 3] RGB or [H, W] pixels, or the content of a picture file, stored byte for byte.
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
        try:
            self._log.append(record)
        except OSError as cause:
            raise SessionError(
                f"{self.path}: frame {record.index} cannot be logged: {cause.strerror or cause}; "
                "the frames before it are safe."
            ) from cause
        self._remember(record)
        if self.status != "recording":
            self.status = "recording"
            self._write_manifest()

    def replace_frames(self, records: Sequence[FrameRecord]) -> None:
        """Exchanges the log for one of the same frames in one step, as when they are tagged later."""
        if sorted(record.index for record in records) != sorted(self._by_index):
            raise SessionError(f"{self.path}: the log can only be replaced by one of the same frames.")
        try:
            self._log.replace(records)
        except OSError as cause:
            raise SessionError(
                f"{self.path}: the log cannot be replaced: {cause.strerror or cause}."
            ) from cause
        self.frames, self._by_index, self._by_file = [], {}, {}
        for record in records:
            self._remember(record)

    def update_info(self, **entries: Any) -> None:
        """Sets entries of session.json, such as a report of the tagging, and writes it."""
        if reserved := sorted(entries.keys() & RESERVED_KEYS):
            raise ValueError(f"{reserved[0]} is not an entry to set")
        self.info.update(entries)
        self._write_manifest()

    def finish(self, status: str = "complete") -> None:
        """Closes the log and records how the capture ended."""
        if status not in STATUSES:
            raise ValueError(f"status is {status!r}, not one of {', '.join(STATUSES)}")
        self._log.close()
        self.status = status
        self._write_manifest()

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
                f"{self.path}: frame {record.index} ({record.file}) is {width} x {height} pixels, its record "
                f"says {record.width} x {record.height}; put the original picture back."
            )
        return image

    def load_radiance(self, record: FrameRecord) -> NDArray[np.float32]:
        """A frame in linear radiance: [H, W, 3], 1.0 = white clip in the middle of the picture.

        Dark level, response, flat field and colour of calibration.json are applied where they are there and
        were made with the settings of this session; else the session's transfer function is all.
        Float pixels (EXR, HDR) have neither dark level nor response.
        """
        return self.radiometry.radiance(self.load_exposure(record))

    def load_exposure(self, record: FrameRecord) -> NDArray[np.float32]:
        """A frame as the sensor was exposed, linear: [H, W, 3], 1.0 = white clip; for clipping and noise."""
        return self.radiometry.exposure(self.load_image(record))

    @property
    def radiometry(self) -> Radiometry:
        """What makes radiance of this session's pixels."""
        if self._radiometry is None:
            entries, warning = self.read_calibration()
            if warning is not None:
                logger.warning("%s: %s", self.calibration_path, warning)
            self._radiometry = radiometry_of(entries, self.info["image"]["transfer"])
        return self._radiometry

    @property
    def controls(self) -> Controls:
        """What the camera was set to, as far as the session tells."""
        return controls_of_session(self.info, self.frames)

    def read_calibration(self) -> tuple[Fields, str | None]:
        """The entries of calibration.json that hold for this session; none where there is no file.

        Returns:
            The entries, and a sentence on those that were made with other settings and are not applied.

        Raises:
            CalibrationError: malformed.
        """
        if not self.calibration_path.is_file():
            return Fields({}, str(self.calibration_path), CalibrationError), None
        return applicable_entries(read_calibration_entries(self.calibration_path), self.controls)

    def load_mask(self, record: FrameRecord) -> NDArray[np.uint8] | None:
        """The subject's coverage in a frame: [H, W] 0..255; None where there is no mask."""
        path = self.mask_path(record.index)
        if not path.is_file():
            return None
        mask = read_image(path)
        if mask.dtype != np.uint8 or mask.shape != (record.height, record.width):
            raise SessionError(
                f"{path} must be an 8-bit grey mask of {record.width} x {record.height} pixels."
            )
        return mask

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
    def sparse_path(self) -> Path:
        """The points that the poses were found with, where they were found and not given."""
        return self.scene_dir / "sparse.ply"

    @property
    def dense_path(self) -> Path:
        """The cloud as stereo leaves it, before it is cleaned into `points_path`."""
        return self.scene_dir / "dense.ply"

    @property
    def masks_dir(self) -> Path:
        """Masks by frame index."""
        return self.scene_dir / "masks"

    def mask_path(self, index: int) -> Path:
        """Where a frame's mask is or would be: 8-bit grey PNG, 255 = subject."""
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
        """Poses by frame index, with the flash of each frame's record.

        Raises:
            SourceError: there is no model, or it is malformed.
            SessionError: it is not one of this session's frames.
        """
        cameras = {}
        for name, camera in read_colmap_model(self.cameras_dir).cameras.items():
            record = self._by_file.get(name)
            if record is None or (camera.width, camera.height) != (record.width, record.height):
                raise SessionError(
                    f"{self.cameras_dir}: the camera of {name!r} ({camera.width} x {camera.height} pixels) "
                    "fits no frame of the session; delete the folder and find the poses again."
                )
            cameras[record.index] = replace(camera, flash=record.flash)
        return cameras

    def _complaint(self, record: FrameRecord) -> str | None:
        """What keeps a record from being added."""
        if record.index in self._by_index:
            return f"the frame {record.index} is there already"
        if record.file in self._by_file:
            return f"the picture {record.file} belongs to another frame"
        return None

    def _with_file_checked(self, record: FrameRecord) -> FrameRecord:
        """The record with the reason "missing_file" exactly when its picture is missing."""
        reasons = tuple(reason for reason in record.reasons if reason != "missing_file")
        if record.file is not None and not (self.path / record.file).is_file():
            self._repaired(
                f"The picture {record.file} of frame {record.index} is missing; the frame is not used."
            )
            reasons = (*reasons, "missing_file")
        return record if reasons == record.reasons else replace(record, reasons=reasons)

    def _remember(self, record: FrameRecord) -> None:
        self.frames.append(record)
        self._by_index[record.index] = record
        if record.file is not None:
            self._by_file[record.file] = record

    def _repaired(self, sentence: str) -> None:
        self.repairs.append(sentence)
        logger.warning("%s: %s", self.path, sentence)

    def _write_manifest(self) -> None:
        write_manifest(self.path / "session.json", self.status, self.info)
