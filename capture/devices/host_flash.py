"""A lamp that only knows on and off, made a `FlashDevice`: a thread switches it when its schedule says so.

All decisions are in `HostSchedule`; the thread sleeps until the next one and carries it out. In simulated
time there is no thread: whoever moves the clock calls `run_due` at `next_s`. A guard may stand by for the
case that this process dies; when the whole machine hangs, a lamp without a watchdog stays as it is.

What went wrong in the thread turns the lamp off, ends the train and comes out of the next `poll`.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import weakref
from types import TracebackType
from typing import Any, Protocol, Self

from capture.devices.bench import Clock, MonotonicClock
from capture.devices.flash import LONGEST_ON_S, FlashCapabilities, FlashEdge, FlashInfo, PulseTrain
from capture.devices.host_schedule import LATEST_S, HostSchedule, Step
from capture.errors import FlashError, FlashGoneError

_log = logging.getLogger(__name__)

#: A train may not start nearer than this: the thread has to wake and the lamp to be set.
LEAD_S = 0.02
#: The thread looks up at least so often whether it is still wanted.
_IDLE_S = 1.0
#: A lamp that did not take its command off is told again so often, each so many seconds.
_RETRIES, _RETRY_S = 20, 0.1
#: How long `off` waits for a command that hangs before it goes ahead regardless.
_PATIENCE_S = 1.0


class HostLamp(Protocol):
    """What a bought lamp is to the host. Opened dark; never called by two threads at once."""

    @property
    def info(self) -> FlashInfo:
        """Who it is."""

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do."""

    def prepare(self, level: float) -> None:
        """Sets how bright the flashes to come are, 0 (exclusive) .. 1, while it is dark."""

    def arm(self, on_s: float) -> None:
        """Called right before each flash: a lamp with a watchdog sets it to go out by itself after `on_s`."""

    def switch(self, on: bool) -> None:
        """Gives the command; returns when it has gone out, without waiting for what it does."""

    def check(self, idle_s: float) -> None:
        """Looks at what the device says of itself, taking less than `idle_s`.

        Raises:
            FlashError: It is not as it was told to be.
        """

    def confirm_dark(self) -> bool:
        """Asks the device whether it is dark; False also when it cannot tell."""

    def report(self) -> dict[str, Any]:
        """Plain values for session.json."""

    def close(self) -> None:
        """Puts back what was changed on the device, but stays dark, and lets go of it; may raise."""


class HostGuard(Protocol):
    """Who puts the lamp out should this process die. Never raises."""

    def lit(self, on: bool) -> None:
        """Told before the light goes on and after it is off."""

    def end(self) -> None:
        """The lamp is dark and closed."""


class HostFlash:
    """A `FlashDevice` out of a lamp that the host switches."""

    def __init__(self, lamp: HostLamp, clock: Clock, guard: HostGuard | None = None) -> None:
        """Takes over an opened lamp.

        Args:
            lamp: That is dark.
            clock: Of the bench. In simulated time `run_due` has to be called; else a thread is started.
            guard: Of the lamp; None = nobody.
        """
        self._lamp = lamp
        self._guard = guard
        self._clock = clock
        can = lamp.capabilities
        self._schedule = HostSchedule(can.latency_s or 0.0, can.jitter_s or 0.0)
        self._edges: list[FlashEdge] = []
        self._error: FlashError | None = None
        self._raised = False
        self._closed = threading.Event()
        self._retries = 0
        self._retry_s = 0.0
        # Reentrant: `off` may come from a signal's handler in the middle of `poll`.
        self._lock = threading.RLock()
        self._wake = threading.Event()
        # Dark too when nobody closes it: at the end of the program, or when it is forgotten.
        self._finalizer = weakref.finalize(self, _darken, lamp, self._lock, self._closed, guard)
        self._threaded = isinstance(clock, MonotonicClock)
        if self._threaded:
            wanted = (weakref.ref(self), self._wake)
            threading.Thread(target=_serve, args=wanted, name=lamp.info.back_end, daemon=True).start()

    @property
    def info(self) -> FlashInfo:
        """Who it is."""
        return self._lamp.info

    @property
    def capabilities(self) -> FlashCapabilities:
        """What it can do."""
        return self._lamp.capabilities

    def start(self, train: PulseTrain) -> None:
        """Begins a train, in place of one that runs.

        Raises:
            FlashError: The train is beyond the lamp's capabilities, `start_s` is too near, or what went wrong
                since the last `poll`.
        """
        with self._lock:
            self._raise_error()
            self._check_train(train)
            step = self._schedule.drop()
            if step is not None:
                self._carry_out(step)
                self._retries = 0
            self._lamp.prepare(train.level)
            self._schedule.start(train)
        self._wake.set()

    def poll(self) -> tuple[FlashEdge, ...]:
        """The edges since the last call.

        Raises:
            FlashError: What went wrong; edges from before come out of the call after.
        """
        with self._lock:
            if not self._threaded:
                self.run_due()
            if not self._closed.is_set() and self._error is None:
                next_s = self._schedule.next_s()
                idle_s = float("inf") if next_s is None else next_s - self._clock.now_s()
                try:
                    self._lamp.check(idle_s)
                except FlashError as error:
                    self._fail(error)
            if self._error is not None and not self._raised:
                self._raise_error()
            edges, self._edges = tuple(self._edges), []
            if not edges:
                self._raise_error()
            return edges

    def off(self) -> bool:
        """Puts the light out and drops the train; whether the lamp says that it is dark."""
        locked = self._lock.acquire(timeout=_PATIENCE_S)
        try:
            if self._closed.is_set():
                return False
            step = self._schedule.drop()
            if step is not None:
                self._carry_out(step)
            else:
                self._switch(False)
            self._retries = 0
            return self._lamp.confirm_dark()
        except Exception as error:
            _log.warning("%s was told to go out, but did not take it: %s", self._lamp.info.name, error)
            return False
        finally:
            if locked:
                self._lock.release()

    def link_report(self) -> dict[str, Any]:
        """Flashes made and left out, whether there is a guard, and what the lamp says of itself."""
        return self._schedule.report() | {"guarded": self._guard is not None} | self._lamp.report()

    def next_s(self) -> float | None:
        """When `run_due` has something to do; None = never."""
        if self._retries:
            return self._retry_s
        return None if self._error is not None else self._schedule.next_s()

    def run_due(self) -> None:
        """Does what is due by now. The thread's work; in simulated time its caller's."""
        with self._lock:
            if self._retries and not self._closed.is_set() and self._clock.now_s() >= self._retry_s:
                self._try_dark()
            while not self._closed.is_set() and self._error is None:
                left_out = len(self._schedule.skipped)
                step = self._schedule.due(self._clock.now_s())
                if len(self._schedule.skipped) > left_out:
                    _log.warning("%s: a flash could not begin in time and was left out", self.info.name)
                if step is None:
                    return
                try:
                    self._carry_out(step)
                    if not step.on:
                        self._check_length()
                except Exception as error:  # a thread has nobody else to tell
                    self._fail(error)

    def close(self) -> None:
        """Turns the light off and lets go of the lamp."""
        if self._closed.is_set():
            return
        self.off()
        with self._lock:
            self._closed.set()
            self._finalizer.detach()
            with contextlib.suppress(FlashError):  # it is gone: nothing can be put back
                self._lamp.close()
            if self._guard is not None:
                self._guard.end()
        self._wake.set()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()

    def _check_train(self, train: PulseTrain) -> None:
        name, can = self._lamp.info.name, self._lamp.capabilities
        if self._closed.is_set():
            raise FlashError(f"{name} has been closed; open it again.")
        if not can.shortest_on_s <= train.on_s <= can.longest_on_s:
            raise FlashError(
                f"A flash of {train.on_s} s is not for {name}; it can do {can.shortest_on_s} to "
                f"{can.longest_on_s} s."
            )
        if train.period_s < can.shortest_period_s:
            raise FlashError(
                f"A period of {train.period_s} s is not for {name}; ask for {can.shortest_period_s} s or "
                "more."
            )
        if train.level < 1 and not can.dimmable:
            raise FlashError(f"{name} cannot be dimmed; ask for level 1, not {train.level}.")
        ahead_s = train.start_s - self._clock.now_s()
        if ahead_s < LEAD_S:
            raise FlashError(
                f"The train starts in {ahead_s:.3f} s; {name} needs {LEAD_S} s: let it start later."
            )

    def _carry_out(self, step: Step) -> None:
        if step.on:
            train = self._schedule.train
            assert train is not None
            self._lamp.arm(train.on_s)
            if self._guard is not None:
                self._guard.lit(True)
        before_s = self._clock.now_s()
        self._switch(step.on)
        self._edges.append(self._schedule.done(step, before_s, self._clock.now_s()))

    def _switch(self, on: bool) -> None:
        self._lamp.switch(on)
        if self._guard is not None and not on:
            self._guard.lit(False)

    def _check_length(self) -> None:
        if self._schedule.last_on_s > LONGEST_ON_S + LATEST_S:
            raise FlashError(
                f"{self._lamp.info.name} was lit for {self._schedule.last_on_s:.2f} s, and the limit is "
                f"{LONGEST_ON_S} s: this machine is too busy to switch it in time; end other programs."
            )

    def _fail(self, error: Exception) -> None:
        if not isinstance(error, FlashError):
            _log.exception("The thread of %s failed", self._lamp.info.name, exc_info=error)
            error = FlashError(f"{self._lamp.info.name} failed ({error}); start again.")
        self._error, self._raised = error, False
        self._retries = _RETRIES
        self._try_dark()

    def _try_dark(self) -> None:
        step = self._schedule.drop()
        before_s = self._clock.now_s()
        try:
            self._switch(False)
        except Exception as error:  # the failure is told already
            self._retries -= 1
            self._retry_s = self._clock.now_s() + _RETRY_S
            _log.debug("%s does not go out: %s", self._lamp.info.name, error)
            return
        self._retries = 0
        if step is not None:
            self._edges.append(self._schedule.done(step, before_s, self._clock.now_s()))

    def _raise_error(self) -> None:
        error = self._error
        if error is None:
            return
        self._raised = True
        if not isinstance(error, FlashGoneError):
            self._error = None
        raise error

    def _serve_once(self) -> float | None:
        """Does what is due; how long there is nothing to do, None = the flash is closed."""
        self.run_due()
        with self._lock:
            if self._closed.is_set():
                return None
            next_s = self.next_s()
            if next_s is None:
                return _IDLE_S
            return min(_IDLE_S, max(0.0, next_s - self._clock.now_s()))


def _serve(flash: weakref.ref[HostFlash], wake: threading.Event) -> None:
    """The thread. Holds no reference while it sleeps, so that a forgotten flash can end it."""
    while True:
        strong = flash()
        wait_s = None if strong is None else strong._serve_once()
        del strong
        if wait_s is None:
            return
        wake.wait(wait_s)
        wake.clear()


def _darken(lamp: HostLamp, lock: threading.RLock, closed: threading.Event, guard: HostGuard | None) -> None:
    closed.set()  # the thread switches nothing any more
    locked = lock.acquire(timeout=_PATIENCE_S)
    try:
        with contextlib.suppress(Exception):  # the program ends; there is nobody to tell
            lamp.switch(False)
            lamp.close()
            if guard is not None:
                guard.end()
    finally:
        if locked:
            lock.release()
