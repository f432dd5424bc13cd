"""A camera's response: from stored values to linear radiance, by a named curve or a measured table.

The form in calibration.json, under "response":

    {"transfer": "srgb", "source": ...}                                a named curve
    {"table": {"stored": [n], "linear": [n] or [n][3]}, "source": ...} measured, stored 0..1, 1.0 = white clip
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.calibration_file import made_with_of, read_calibration_entries
from capture.controls import Controls
from capture.errors import TransferError
from capture.json_fields import Fields
from capture.transfer import canonical_transfer, to_linear


@dataclass(frozen=True, eq=False)
class Response:
    """A named curve or a table, piecewise linear between its entries.

    Attributes:
        transfer: a name of `capture.transfer`; None = `stored` and `linear` count.
        stored: [n] stored values 0..1, rising.
        linear: [n] or [n, 3] (R, G, B) radiance at these, never falling, 1.0 = white clip.
        source: where it comes from.
        made_with: the camera that it holds for; None = not known.
    """

    transfer: str | None
    stored: NDArray[np.float64] | None = None
    linear: NDArray[np.float64] | None = None
    source: str = ""
    made_with: Controls | None = None

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ValueError: neither or both forms, lengths that differ, or a table that does not rise.
        """
        if (self.transfer is None) == (self.stored is None) or (self.stored is None) != (self.linear is None):
            raise ValueError("a response is a transfer name, or the two columns of a table")
        if self.transfer is not None:
            canonical_transfer(self.transfer)
        if self.stored is None or self.linear is None:
            return
        count = self.stored.size
        if count < 2 or self.stored.ndim != 1 or self.linear.shape not in ((count,), (count, 3)):
            raise ValueError("the table needs two or more entries, with one or three linear values each")
        if not (np.diff(self.stored) > 0).all() or self.stored[0] < 0 or self.stored[-1] > 1:
            raise ValueError("the table's stored values must rise within 0..1")
        if not (np.diff(self.linear, axis=0) >= 0).all():
            raise ValueError("the table's linear values must not fall")

    def to_linear(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """Linear radiance of stored values.

        Args:
            values: [..., 3] RGB, uint8, uint16 or float 0..1. Outside the table its end values hold.

        Returns:
            float32 of the same shape.
        """
        if self.transfer is not None:
            return to_linear(values, self.transfer)
        assert self.stored is not None
        assert self.linear is not None
        channels = self.linear if self.linear.ndim == 2 else np.repeat(self.linear[:, None], 3, axis=1)
        radiance = np.empty(values.shape, dtype=np.float32)
        for channel in range(3):
            plane = values[..., channel]
            if plane.dtype in (np.uint8, np.uint16):
                codes = np.linspace(0.0, 1.0, np.iinfo(plane.dtype).max + 1)
                table = np.interp(codes, self.stored, channels[:, channel]).astype(np.float32)
                radiance[..., channel] = np.take(table, plane, mode="clip")
            else:
                radiance[..., channel] = np.interp(plane, self.stored, channels[:, channel])
        return radiance

    def to_json(self) -> dict[str, Any]:
        """The entry of calibration.json."""
        entry: dict[str, Any] = {"source": self.source}
        if self.made_with is not None and (settings := self.made_with.to_json()):
            entry["made_with"] = settings
        if self.stored is None or self.linear is None:
            return {"transfer": self.transfer, **entry}
        return {"table": {"stored": self.stored.tolist(), "linear": self.linear.tolist()}, **entry}


def load_response(calibration: Path) -> Response | None:
    """The response of a calibration.json; None where there is no file or no response in it.

    Raises:
        CalibrationError: malformed.
    """
    if not calibration.is_file():
        return None
    entry = read_calibration_entries(calibration).child("response", None)
    return None if entry is None else response_from_json(entry)


def response_from_json(entry: Fields) -> Response:
    """The response that a "response" entry describes."""
    try:
        source = entry.text("source", "")
        if (table := entry.child("table", None)) is None:
            name = canonical_transfer(entry.text("transfer"))
            return Response(name, source=source, made_with=made_with_of(entry))
        column = table.values.get("linear")
        wide = isinstance(column, list) and column and isinstance(column[0], list)
        linear = table.array("linear", (None, 3) if wide else (None,))
        return Response(None, table.array("stored", (None,)), linear, source, made_with_of(entry))
    except TransferError as cause:
        raise entry.fail(str(cause)) from cause
    except ValueError as cause:
        raise entry.fail(f"{cause}.") from cause
