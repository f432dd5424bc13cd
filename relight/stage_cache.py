"""What of a session's scene folder was computed, from what and how: `scene/stages.json`.

A stage (poses, cloud, masks, scale) is done again only when what it depends on has changed. Its key is a
hash over

* the version of its method, a number in `VERSIONS` that changes with the method,
* its settings,
* the frames it reads: names and contents of the pictures, and their flash flags,
* its inputs from other stages: their keys where they were computed, a hash of the files where given.

Files of the scene folder without an entry, or changed since, were given by the user: they are used as they
are and never overwritten.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from capture.atomic import atomic_write
from capture.frame_record import FrameRecord
from capture.json_fields import parse_json
from capture.session import Session

VERSIONS = {"poses": 1, "cloud": 1, "masks": 1, "scale": 1, "solve": 2}
"""Of the stages' methods; raising one has the stage done again."""

_SCHEMA = 1
_BLOCK = 1 << 20


@dataclass(frozen=True)
class StageRecord:
    """What is remembered of a stage that was done.

    Attributes:
        key: Of everything it depended on.
        output: Hash of what it wrote; empty while it is being written.
        settings: Resolved.
        report: What it found out, plain numbers and texts.
        warnings: Sentences for the user.
        seconds: Wall-clock time it took.
        peak_memory_mb: Most memory that the process held in it; None where the system does not say.
    """

    key: str
    output: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    report: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    peak_memory_mb: float | None = None


class StageCache:
    """The entries of one session's stages.json, read once and written whole."""

    def __init__(self, session: Session) -> None:
        """Reads what there is; a file that cannot be read counts as none, for all in it can be had again."""
        self._session = session
        self._path = session.scene_dir / "stages.json"
        self._records = _read(self._path)
        self._outputs = {
            "poses": (session.cameras_dir, session.sparse_path),
            "cloud": (session.points_path, session.dense_path),
            "masks": (session.masks_dir,),
        }
        self._frames: dict[tuple[int, ...], str] = {}

    def record(self, stage: str) -> StageRecord | None:
        """The stage's entry, if its files are there as it left them; None where they were given."""
        record = self._records.get(stage)
        if record is None or (stage in self._outputs and record.output != self._output(stage)):
            return None
        return record

    def is_given(self, stage: str) -> bool:
        """Whether the stage's files are there and are none of ours, nor the torn rest of ours."""
        if not _is_there(self._outputs[stage][0]):
            return False
        record = self._records.get(stage)
        return record is None or (record.output != "" and record.output != self._output(stage))

    def is_whole(self, stage: str) -> bool:
        """Whether the stage's files can be read: given, or ours and untorn, though perhaps out of date."""
        return self.is_given(stage) or self.record(stage) is not None

    def identity(self, stage: str) -> str:
        """What those who depend on the stage put into their keys; empty where there is nothing."""
        record = self.record(stage)
        if record is not None:
            return record.key
        return f"given {self._output(stage)}" if self.is_given(stage) else ""

    def key(
        self,
        stage: str,
        settings: Mapping[str, Any],
        frames: Sequence[FrameRecord],
        inputs: Iterable[str] = (),
    ) -> str:
        """Hash of all that a stage depends on; `inputs` are `identity`s."""
        calibration = self._session.calibration_path
        parts = [
            stage,
            str(VERSIONS[stage]),
            json.dumps(settings, sort_keys=True, default=str),
            self._frame_hash(frames),
            hash_files([calibration]) if calibration.is_file() else "",
            *inputs,
        ]
        return hashlib.blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()

    def reports(self) -> dict[str, dict[str, Any]]:
        """What each stage that was computed found out, with its time and memory, for a portrait's metrics."""
        return {
            stage: {
                **record.report,
                "seconds": record.seconds,
                "peak_memory_mb": record.peak_memory_mb,
            }
            for stage, record in self._records.items()
        }

    def warnings(self) -> list[str]:
        """Sentences for the user, of all stages."""
        return [warning for record in self._records.values() for warning in record.warnings]

    def forget_all(self) -> None:
        """Has every stage that was computed done again; what was given stays given."""
        self._records = {
            stage: replace(record, key="")
            for stage, record in self._records.items()
            if stage not in self._outputs or not self.is_given(stage)
        }
        self._write()

    def begin(self, *stages: str) -> None:
        """Says that files of stages are about to be written: what is torn then is none of the user's."""
        for stage in stages:
            known = self._records.get(stage, StageRecord(key="", output=""))
            self._records[stage] = replace(known, output="")
        self._write()

    def store(
        self,
        stage: str,
        key: str,
        *,
        settings: Mapping[str, Any],
        report: Mapping[str, Any],
        warnings: Sequence[str] = (),
        seconds: float = 0.0,
        peak_memory_mb: float | None = None,
    ) -> None:
        """Remembers a stage whose files have just been written."""
        output = self._output(stage) if stage in self._outputs else ""
        self._records[stage] = StageRecord(
            key, output, dict(settings), dict(report), tuple(warnings), round(seconds, 3), peak_memory_mb
        )
        self._write()

    def moved(self, *stages: str) -> None:
        """To be called when files were rewritten that are the same result still, as in another unit."""
        for stage in stages:
            if (record := self._records.get(stage)) is not None:
                self._records[stage] = replace(record, output=self._output(stage))
        self._write()

    def _output(self, stage: str) -> str:
        return hash_files([file for path in self._outputs[stage] for file in _files(path)])

    def _frame_hash(self, frames: Sequence[FrameRecord]) -> str:
        indices = tuple(record.index for record in frames)
        if indices not in self._frames:
            digest = hashlib.blake2b(digest_size=16)
            for record in frames:
                digest.update(f"{record.index} {record.flash} {record.pts_s}\0".encode())
                if record.file is not None:
                    digest.update(hash_files([self._session.path / record.file]).encode())
            transfer = self._session.info["image"]["transfer"]
            self._frames[indices] = digest.hexdigest() + transfer
        return self._frames[indices]

    def _write(self) -> None:
        content = {
            "schema": _SCHEMA,
            "stages": {
                stage: {
                    "key": record.key,
                    "output": record.output,
                    "settings": record.settings,
                    "report": record.report,
                    "warnings": list(record.warnings),
                    "seconds": record.seconds,
                    "peak_memory_mb": record.peak_memory_mb,
                }
                for stage, record in self._records.items()
            },
        }
        self._path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(self._path, (json.dumps(content, indent=2, default=str) + "\n").encode())


def _read(path: Path) -> dict[str, StageRecord]:
    try:
        content = parse_json(path.read_bytes())
        if content["schema"] != _SCHEMA:
            return {}
        return {
            str(stage): StageRecord(
                key=str(entry["key"]),
                output=str(entry["output"]),
                settings=dict(entry["settings"]),
                report=dict(entry["report"]),
                warnings=tuple(str(warning) for warning in entry["warnings"]),
                seconds=float(entry["seconds"]),
                peak_memory_mb=entry["peak_memory_mb"],
            )
            for stage, entry in content["stages"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _is_there(path: Path) -> bool:
    return path.is_file() or (path.is_dir() and any(path.iterdir()))


def _files(path: Path) -> list[Path]:
    """The file itself, or those in a folder by name."""
    if path.is_file():
        return [path]
    return sorted(file for file in path.glob("*") if file.is_file()) if path.is_dir() else []


def hash_files(files: Iterable[Path]) -> str:
    """Of names and contents, in the given order."""
    digest = hashlib.blake2b(digest_size=16)
    for file in files:
        digest.update(file.name.encode() + b"\0")
        try:
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK):
                    digest.update(block)
        except OSError:
            digest.update(b"unreadable")
    return digest.hexdigest()
