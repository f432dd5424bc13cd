"""The light of a lamp that lives in another process and writes its edges to a file as they happen.

    <CLOCK_MONOTONIC ns> 1     the lamp goes on
    <CLOCK_MONOTONIC ns> 0     it goes off
    <CLOCK_MONOTONIC ns> t     its time has come so far

So a simulated camera can be lit by the real firmware, in a simulated chip or built for the host.
"""

from __future__ import annotations

from pathlib import Path

from capture.devices.bench import Clock
from capture.errors import CameraError

_LOOK_S = 0.004


class EdgeFile:
    """Reads the file as it grows.

    Attributes:
        pulses: (on_s, off_s) so far, host clock; the last may still be burning, with an end of infinity.
        until_s: the lamp's light is known until then.
    """

    def __init__(self, path: Path) -> None:
        """Of a file that exists already.

        Raises:
            CameraError: It does not.
        """
        self.pulses: list[tuple[float, float]] = []
        self.until_s = float("-inf")
        self._path = path
        self._rest = b""
        try:
            self._file = path.open("rb")
        except OSError as cause:
            raise CameraError(f"{path}: no lamp writes its edges there: {cause.strerror}.") from cause

    def wait_until(self, time_s: float, clock: Clock, timeout_s: float) -> bool:
        """Reads until the light is known up to a time; whether it came to be within the timeout.

        Raises:
            CameraError: A line is not understood.
        """
        give_up_s = clock.now_s() + timeout_s
        while True:
            self._read()
            if self.until_s >= time_s:
                return True
            if clock.now_s() >= give_up_s:
                return False
            clock.sleep(_LOOK_S)

    def near(self, begin_s: float, end_s: float) -> list[tuple[float, float]]:
        """The pulses that burn within an interval."""
        return [(on, off) for on, off in self.pulses if on < end_s and off > begin_s]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _read(self) -> None:
        *lines, self._rest = (self._rest + self._file.read()).split(b"\n")
        for line in lines:
            try:
                stamp, what = line.split()
                time_s = int(stamp) * 1e-9
            except ValueError as cause:
                raise CameraError(f"{self._path}: {line!r} is no edge of a lamp.") from cause
            if what == b"1":
                self.pulses.append((time_s, float("inf")))
            elif what == b"0" and self.pulses:
                self.pulses[-1] = (self.pulses[-1][0], time_s)
            self.until_s = time_s
