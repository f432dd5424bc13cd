"""A fit's state on the disk, so that it can be stopped and go on, on another device too.

    state-NNNNNN.safetensors   tensors: what is learned, the optimiser's moments, the state of chance
    state.json                 which of them counts, and the rest of the state

state.json is written last and names its tensors, so a power cut leaves the state before or the state after.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from capture.atomic import atomic_write
from capture.json_fields import parse_json
from relight.errors import RefineError

_FIELDS_FILE = "state.json"
_SCHEMA = 1


def save_state(
    folder: Path, step: int, tensors: Mapping[str, torch.Tensor], content: Mapping[str, Any]
) -> None:
    """Writes a state and removes the one before.

    Args:
        folder: Made if it is not there.
        step: Names the file.
        tensors: By name, on any device.
        content: Safe for JSON.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"state-{step:06d}.safetensors"
    whole = {name: values.detach().cpu().contiguous().clone() for name, values in tensors.items()}
    atomic_write(file, save(whole))
    fields = {"schema": _SCHEMA, "tensors": file.name, "content": dict(content)}
    atomic_write(folder / _FIELDS_FILE, (json.dumps(fields, indent=1, allow_nan=False) + "\n").encode())
    for other in folder.glob("state-*.safetensors"):
        if other != file:
            other.unlink()


def load_state(
    folder: Path, device: torch.device | str
) -> tuple[dict[str, torch.Tensor], dict[str, Any]] | None:
    """The state in a folder; None where there is none.

    Raises:
        RefineError: There is one that cannot be read.
    """
    path = folder / _FIELDS_FILE
    if not path.is_file():
        return None
    try:
        fields = parse_json(path.read_bytes())
        if fields["schema"] != _SCHEMA:
            raise ValueError(f"schema {fields['schema']} is not {_SCHEMA}")
        return load_file(folder / Path(fields["tensors"]).name, device=str(device)), dict(fields["content"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise RefineError(
            f"The checkpoint in {folder} cannot be read ({error}); remove the folder, or fit with --fresh."
        ) from error
