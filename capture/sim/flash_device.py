"""The simulated flash: puts its pulses on the bench, where the simulated cameras see them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np

from capture.devices.bench import Bench
from capture.devices.flash import FlashCapabilities, FlashEdge, FlashInfo, PulseTrain
from capture.errors import FlashError, FlashGoneError, FlashResetError

_LATENCY_S = 0.0008
_EDGE_SIGMA_S = 0.0001


@dataclass(frozen=True)
class FlashFaults:
    """What goes wrong.

    Attributes:
        missed: share of pulses that do not happen though they are reported.
        jitter_s: standard deviation of the light's start and end about the reported edges.
        unplug_s: it is gone from so long after the train's start on; None = never.
        reset_s: it restarts then; None = never.
        seed: of the chance.
    """

    missed: float = 0.0
    jitter_s: float = 0.0002
    unplug_s: float | None = None
    reset_s: float | None = None
    seed: int = 0


class SimulatedFlash:
    """A `FlashDevice` with a schedule of its own."""

    def __init__(self, url: str, bench: Bench, faults: FlashFaults) -> None:
        """Dark."""
        self.info = FlashInfo(url=url, name="simulated flash", back_end="sim", details={})
        self.capabilities = FlashCapabilities(
            own_schedule=True,
            watchdog=True,
            shortest_on_s=0.001,
            latency_s=_LATENCY_S,
            jitter_s=faults.jitter_s,
            dimmable=False,
        )
        self._bench, self._faults = bench, faults
        self._train: PulseTrain | None = None
        self._edges: deque[FlashEdge] = deque()
        self._fails_s = float("inf")
        self._failure: FlashError | None = None

    def start(self, train: PulseTrain) -> None:
        """See `FlashDevice.start`."""
        now_s = self._bench.clock.now_s()
        self._fail_if_due(now_s)
        if self._failure is not None:
            raise self._failure
        if train.start_s < now_s:
            raise FlashError(
                f"The train starts {now_s - train.start_s:.3f} s ago; start it a little in the future."
            )
        if train.level != 1:
            raise FlashError(f"The simulated flash has one level, 1; it was asked for {train.level}.")
        self._put_out(now_s)
        self._train = train
        self._edges.clear()
        faults = self._faults
        rng = np.random.default_rng([faults.seed, 91])
        for pulse in range(train.count):
            on_s = train.start_s + pulse * train.period_s
            self._edges.append(FlashEdge(time_s=on_s, sigma_s=_EDGE_SIGMA_S, on=True, pulse=pulse))
            self._edges.append(
                FlashEdge(time_s=on_s + train.on_s, sigma_s=_EDGE_SIGMA_S, on=False, pulse=pulse)
            )
            late_s = _LATENCY_S + faults.jitter_s * np.clip(rng.normal(size=2), -4, 4)
            if rng.random() >= faults.missed:
                self._bench.light.pulses.append(
                    (on_s + float(late_s[0]), on_s + train.on_s + float(late_s[1]))
                )
        due = [after for after in (faults.unplug_s, faults.reset_s) if after is not None]
        if due:
            self._fails_s = train.start_s + min(due)
            self._darken_from(self._fails_s)

    def poll(self) -> tuple[FlashEdge, ...]:
        """See `FlashDevice.poll`."""
        now_s = self._bench.clock.now_s()
        self._fail_if_due(now_s)
        edges = []
        while self._edges and self._edges[0].time_s <= min(now_s, self._fails_s):
            edges.append(self._edges.popleft())
        if not edges and self._failure is not None:
            raise self._failure
        return tuple(edges)

    def off(self) -> bool:
        """See `FlashDevice.off`."""
        now_s = self._bench.clock.now_s()
        self._put_out(now_s)
        self._fail_if_due(now_s)
        return self._failure is None

    def link_report(self) -> dict[str, Any]:
        """Nothing: there is no link."""
        return {}

    def close(self) -> None:
        """See `FlashDevice.close`."""
        self.off()
        self._failure = self._failure or FlashError("The simulated flash is closed; open it again.")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put_out(self, now_s: float) -> None:
        cut = next((edge for edge in self._edges if edge.time_s > now_s), None)
        self._edges = deque(edge for edge in self._edges if edge.time_s <= now_s)
        if cut is not None and not cut.on:  # it burns: it goes out now, not then
            self._edges.append(replace(cut, time_s=now_s))
        self._darken_from(now_s)

    def _darken_from(self, time_s: float) -> None:
        light = self._bench.light
        light.pulses = [(on, min(off, time_s)) for on, off in light.pulses if on < time_s]

    def _fail_if_due(self, now_s: float) -> None:
        if now_s < self._fails_s or self._failure is not None:
            return
        if self._faults.unplug_s is not None:
            self._failure = FlashGoneError("The simulated flash was unplugged; plug it in again.")
        else:
            self._failure = FlashResetError("The simulated flash has restarted; its light is off.")
