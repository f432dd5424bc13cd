"""What session.json says of a capture: what was counted, what the devices report, what the frames show."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from capture.devices.camera import CapturedFrame, LockReport
from capture.devices.flash import FlashDevice
from capture.tagging.stream_summary import StreamResult


@dataclass
class Counts:
    """What is counted while frames come.

    Attributes:
        frames: That came.
        lost: That the camera's sequence says are missing.
        damaged: That are no pictures.
        stamps_repaired: Whose stamp could not be.
        edges: That the flash reported.
        waits: How often the disk was too slow.
        wall_s: From the first to the last.
        cpu_s: Processor time of the whole program in between.
    """

    frames: int = 0
    lost: int = 0
    damaged: int = 0
    stamps_repaired: int = 0
    edges: int = 0
    waits: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    _expected: int | None = None

    def start(self, now_s: float, cpu_s: float) -> None:
        """The first frame is about to be asked for."""
        self.wall_s, self.cpu_s = -now_s, -cpu_s

    def end(self, now_s: float, cpu_s: float) -> None:
        """The last one is on the disk."""
        self.wall_s += now_s
        self.cpu_s += cpu_s

    def frame(self, frame: CapturedFrame) -> int:
        """Counts a frame; how many were lost just before it."""
        lost = 0 if self._expected is None else max(0, frame.sequence - self._expected)
        self._expected = frame.sequence + 1
        self.frames += 1
        self.lost += lost
        return lost


def pulse_warning(on_s: float, lock: LockReport, fps: float) -> list[str]:
    """A sentence when not every flash must light a frame in full.

    It does when t_on >= exposure + readout + frame period (each row of some frame then lies wholly within the
    flash). The readout is not known before the flash has been seen; it is no longer than the frame period.
    """
    exposure_s = lock.value("exposure_s")
    if exposure_s is None:
        return []
    needed_s = exposure_s + 2.0 / fps
    if on_s >= needed_s:
        return []
    return [
        f"A flash of {1e3 * on_s:.0f} ms may light no frame in full: exposure, readout and frame period can "
        f"take {1e3 * needed_s:.0f} ms at {fps:g} frames a second; lengthen it (--on), shorten the "
        "exposure or raise the frame rate."
    ]


def capture_report(
    flash: FlashDevice, counts: Counts, result: StreamResult | None, stopped: str | None
) -> dict[str, Any]:
    """The entry "capture" of session.json."""
    return {
        "frames": counts.frames,
        "lost": counts.lost,
        "damaged": counts.damaged,
        "stamps_repaired": counts.stamps_repaired,
        "flash_edges": counts.edges,
        "waits_for_disk": counts.waits,
        "wall_s": round(counts.wall_s, 3),
        "cpu_s": round(counts.cpu_s, 3),
        "stopped": stopped,
        "link": flash.link_report(),
        "light": None if result is None else _light(result),
    }


def _light(result: StreamResult) -> dict[str, Any]:
    """What the frames show of the flash, without the tables of single pulses."""
    left_out = {"frames", "on_s", "off_s", "light", "warnings"}
    return {
        field.name: _plain(getattr(result, field.name))
        for field in fields(result)
        if field.name not in left_out
    }


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
