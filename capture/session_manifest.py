"""session.json: schema, status and what is known of the whole capture."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from capture.atomic import atomic_write
from capture.cameras import LARGEST_SIDE
from capture.errors import SessionError, TransferError
from capture.json_fields import Fields, read_json
from capture.transfer import canonical_transfer

SCHEMA = "relight-session"
SCHEMA_VERSION = 1
STATUSES = ("recording", "complete", "interrupted")
ROTATIONS_DEG = (0, 90, 180, 270)
RESERVED_KEYS = frozenset({"schema", "version", "status"})


def read_manifest(path: Path) -> tuple[str, dict[str, Any]]:
    """(status, other entries) of a session.json.

    Raises:
        SessionError: malformed, or of an unknown or newer schema.
    """
    manifest = read_json(path, SessionError)
    schema = manifest.text("schema", "")
    if schema != SCHEMA:
        raise manifest.fail(f"the schema is {schema!r}, not {SCHEMA!r}; this is no session of this program.")
    version = manifest.integer("version", low=1)
    if version > SCHEMA_VERSION:
        raise manifest.fail(
            f"it was written by a newer program (schema version {version}; this one knows {SCHEMA_VERSION}); "
            "update the program."
        )
    status: str = manifest.text("status")
    if status not in STATUSES:
        raise manifest.fail(f"the status is {status!r}, not one of {', '.join(STATUSES)}.")
    manifest.child("source")
    info = {key: value for key, value in manifest.values.items() if key not in RESERVED_KEYS}
    info["image"] = _checked_image(manifest.child("image"))
    return status, info


def write_manifest(path: Path, status: str, info: Mapping[str, Any]) -> None:
    """Writes a session.json in one step.

    Raises:
        SessionError: an entry cannot be written as JSON, or the disk refuses.
    """
    manifest = {"schema": SCHEMA, "version": SCHEMA_VERSION, "status": status, **info}
    try:
        content = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
        atomic_write(path, content.encode() + b"\n")
    except (TypeError, ValueError) as cause:
        raise SessionError(f"{path} cannot hold these entries: {cause}.") from cause
    except OSError as cause:
        raise SessionError(f"{path} cannot be written: {cause.strerror or cause}.") from cause


def _checked_image(image: Fields) -> dict[str, Any]:
    rotation_deg = image.integer("rotation_deg", 0)
    if rotation_deg not in ROTATIONS_DEG:
        raise image.fail(f'"rotation_deg" is {rotation_deg}, not 0, 90, 180 or 270.')
    try:
        transfer = canonical_transfer(image.text("transfer"))
    except TransferError as cause:
        raise image.fail(str(cause)) from cause
    return {
        **image.values,
        "width": image.integer("width", low=1, high=LARGEST_SIDE),
        "height": image.integer("height", low=1, high=LARGEST_SIDE),
        "transfer": transfer,
        "rotation_deg": rotation_deg,
    }
