"""flash.jsonl: the flash's edges as its device reports them, one a line, on the frames' time axis.

    {"time_s": 1.5003, "sigma_s": 0.0001, "on": true, "pulse": 1}

The axis is that of `pts_s` in frames.jsonl up to a constant (the lamp's latency and the place of a stamp
within its frame). It is what a capture that was killed is tagged with when it is taken up again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from capture.atomic import atomic_write
from capture.devices.flash import FlashEdge
from capture.errors import SessionError


class EdgeLog:
    """Appends to the file; each call's lines are handed to the system before it returns."""

    def __init__(self, session: Path) -> None:
        """In a session's folder."""
        self.path = session / "flash.jsonl"
        try:
            self._file = self.path.open("a", encoding="ascii")
        except OSError as cause:
            raise SessionError(f"{self.path} cannot be written: {cause.strerror or cause}.") from cause

    def append(self, edges: Iterable[FlashEdge]) -> None:
        """Writes edges, on the frames' axis."""
        lines = [_line(edge) for edge in edges]
        if not lines:
            return
        try:
            self._file.writelines(lines)
            self._file.flush()
        except OSError as cause:
            raise SessionError(f"{self.path} cannot be written: {cause.strerror or cause}.") from cause

    def close(self) -> None:
        """Closes the file; lines that could not be written are given up, `append` has told."""
        with suppress(OSError):
            self._file.close()


def read_edges(session: Path) -> list[FlashEdge]:
    """The edges of a session, without a torn last line; none where there is no such file.

    Raises:
        SessionError: A line before the last is malformed.
    """
    path = session / "flash.jsonl"
    if not path.is_file():
        return []
    edges = []
    lines = path.read_text("ascii", errors="replace").split("\n")
    for number, line in enumerate(lines[:-1], start=1):
        try:
            edges.append(FlashEdge(**json.loads(line)))
        except (ValueError, TypeError) as cause:
            raise SessionError(f"{path}, line {number} is no edge of a flash: {cause}.") from cause
    return edges


def drop_edges_after(session: Path, last_s: float) -> list[FlashEdge]:
    """Ends the file where the frames end, so that it can be gone on with; what remains.

    What a killed capture has of its flash after its last frame would lie in the break between the parts, or
    in the next part; a torn last line would spoil the one that is appended to it.

    Raises:
        SessionError: A line before the last is malformed, or the file cannot be written.
    """
    path = session / "flash.jsonl"
    if not path.is_file():
        return []
    edges = [edge for edge in read_edges(session) if edge.time_s <= last_s]
    try:
        atomic_write(path, "".join(map(_line, edges)).encode("ascii"))
    except OSError as cause:
        raise SessionError(f"{path} cannot be written: {cause.strerror or cause}.") from cause
    return edges


def _line(edge: FlashEdge) -> str:
    content = {
        "time_s": round(edge.time_s, 7),
        "sigma_s": float(f"{edge.sigma_s:.2g}"),
        "on": edge.on,
        "pulse": edge.pulse,
    }
    return json.dumps(content) + "\n"
