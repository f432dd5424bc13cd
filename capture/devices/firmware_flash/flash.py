"""The flash with the reference firmware as a FlashDevice, on any line.

A thread of its own tends the link (heartbeat, clock, EVENTs) while the caller is elsewhere; with a clock
that does not run by itself there is no thread, and `poll` tends. What goes wrong in the thread comes out of
the next call. The device needs no host to put its light out: 250 ms, the end of the train, and 1.5 s without
a PING do.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from capture.devices.bench import Bench, Clock, MonotonicClock
from capture.devices.firmware_flash.edges import EdgeLog
from capture.devices.firmware_flash.handshake import shake_hands
from capture.devices.firmware_flash.link import FirmwareLink
from capture.devices.firmware_flash.train_ticks import in_ticks
from capture.devices.firmware_flash.transport import ByteTransport
from capture.devices.flash import FlashCapabilities, FlashEdge, FlashInfo, PulseTrain
from capture.errors import FlashError, FlashGoneError
from firmware_protocol import Stat, Stop, encode
from firmware_protocol.messages import Capability, State

log = logging.getLogger(__name__)

#: Shorter flashes are approximate on the ATmega328P.
SHORTEST_ON_S = 20e-6
STOP_TRIES = 5
_TEND_S = 0.02
#: So near its end nobody asks why a train has ended.
_END_SLACK_S = 0.3
#: At most so many reads in a row, so that a line that babbles does not keep callers away.
_READS = 32
#: How long a call waits for another one that is on the line: a new handshake takes up to six seconds.
_LOCK_S = 10.0


def open_firmware_flash(
    transport: ByteTransport,
    bench: Bench,
    *,
    url: str,
    back_end: str,
    details: Mapping[str, Any] | None = None,
) -> FirmwareFlash:
    """Shakes hands on a line that has been opened; the line is closed when that fails.

    Args:
        transport: The line. The flash owns it from now on.
        bench: Its clock is the host's; with one that does not run by itself there is no thread.
        url: That opens it.
        back_end: For `FlashInfo`.
        details: Of the port, for `FlashInfo`.

    Raises:
        FlashError: Nothing answers, or not this firmware.
    """
    flash = FirmwareFlash(transport, bench.clock, url=url, back_end=back_end, details=details or {})
    try:
        flash.shake_hands()
    except BaseException:
        flash.close()
        raise
    return flash


class FirmwareFlash:
    """A flash that runs trains by its own clock."""

    def __init__(
        self, transport: ByteTransport, clock: Clock, *, url: str, back_end: str, details: Mapping[str, Any]
    ) -> None:
        """Takes the line; `shake_hands` comes next."""
        self._link = FirmwareLink(transport, clock)
        self._transport = transport
        self._clock = clock
        self._url, self._back_end, self._details = url, back_end, dict(details)
        self._lock = threading.RLock()
        self._callers = 0  # under _counting: a lost count would keep the thread away for ever
        self._counting = threading.Lock()
        self._closing = threading.Event()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._edges: deque[FlashEdge] = deque()
        self._log = EdgeLog()
        self._failure: FlashError | None = None
        self._needs_hello = True
        self._running: tuple[Stat, float] | None = None  # how the device took the train, and when that ends
        # Dark too when nobody closes it: at the end of the program, or when it is forgotten.
        self._finalizer = weakref.finalize(self, _abandon, transport)

    def shake_hands(self) -> None:
        """Finds the device, dark, and begins to tend it.

        Raises:
            FlashError: Nothing answers, or not this firmware.
        """
        with self._mine():
            shake_hands(self._link)
            self._link.ask(Stop())
            self._needs_hello = False
        if isinstance(self._clock, MonotonicClock) and self._thread is None:
            wanted = (weakref.ref(self), self._closing)
            self._thread = threading.Thread(target=_serve, args=wanted, name=self._url, daemon=True)
            self._thread.start()

    @property
    def info(self) -> FlashInfo:
        """Who it is; its firmware among the details."""
        hello = self._link.hello
        details = dict(self._details)
        if hello is not None:
            details |= {
                "firmware": hello.name,
                "protocol": f"{hello.protocol_major}.{hello.protocol_minor}",
                "tick_hz": hello.tick_hz,
            }
        return FlashInfo(
            url=self._url,
            name=hello.name if hello is not None else self._link.description,
            back_end=self._back_end,
            details=details,
        )

    @property
    def capabilities(self) -> FlashCapabilities:
        """Its own schedule and watchdog; levels and feedback as its HELLO says."""
        hello = self._link.hello
        can = hello.capabilities if hello is not None else 0
        return FlashCapabilities(
            own_schedule=True,
            watchdog=True,
            shortest_on_s=SHORTEST_ON_S,
            latency_s=0.0,
            jitter_s=1 / hello.tick_hz if hello is not None else None,
            dimmable=bool(can & Capability.DIMMABLE),
            feedback=bool(can & Capability.FEEDBACK),
        )

    def start(self, train: PulseTrain) -> None:
        """Has the device run a train, told in its own ticks, in place of one that runs.

        Raises:
            FlashError: Beyond the device's capabilities, or `start_s` is too near; what went wrong before.
            FlashGoneError: The device does not answer.
            FlashResetError: It has restarted just now.
        """
        self._raise_failure()
        with self._mine():
            if self._needs_hello:
                shake_hands(self._link, after_reset=True)
                self._needs_hello = False
            if self._link.hello is None or self._link.clock is None:
                raise FlashGoneError(f"{self._link.description} is not known; open it again.")
            message = in_ticks(
                train, self._link.hello, self._link.clock, self._link.now_s(), self._link.description
            )
            try:
                answer = self._link.ask(message)
            except FlashGoneError:
                self._stop(tries=1)  # the train may have been heard all the same
                raise
            finally:
                self._collect()
            if isinstance(answer, Stat):
                self._log.begin(message, self._link.hello.tick_hz, answer.pulses)
                self._running = (answer, train.end_s)

    def poll(self) -> tuple[FlashEdge, ...]:
        """The edges since the last call, with the device's own times.

        Raises:
            FlashGoneError: The line is not there any more, or the device has been silent for 3 s.
            FlashResetError: It has restarted; once, then the edges from before come, and `start` may follow.
            FlashError: Its heartbeat was lost: once, likewise.
        """
        if self._thread is None and not self._closed:
            with self._mine():
                self._tend_once(0.0)
        self._raise_failure()
        edges = []
        while self._edges:
            edges.append(self._edges.popleft())
        return tuple(edges)

    def off(self) -> bool:
        """STOP, up to five times in half a second; whether the device has confirmed that it is dark."""
        if self._closed:
            return False
        try:
            with self._mine():
                return self._stop(STOP_TRIES)
        except Exception as error:
            log.warning("%s: off has failed: %s", self._link.description, error)
            return False

    def link_report(self) -> dict[str, Any]:
        """Round trips, repeats, faults, resets, the clock's fit, edges whose EVENT never came."""
        with self._mine():
            return self._link.report() | {
                "edges_missing": self._log.missing,
                "edges_strange": self._log.strange,
            }

    def close(self) -> None:
        """Off, and the line is let go of."""
        if self._closed:
            return
        try:
            self.off()
        finally:
            self._closed = True
            self._closing.set()
            self._finalizer.detach()
            if self._thread is not None and self._thread is not threading.current_thread():
                self._thread.join(_LOCK_S)  # it is at most in a read of 20 ms or a write of 500 ms
            self._transport.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes it."""
        self.close()

    @contextmanager
    def _mine(self) -> Iterator[None]:
        """The line for this thread; the tending thread stands back for whoever asks."""
        with self._counting:
            self._callers += 1
        try:
            if not self._lock.acquire(timeout=_LOCK_S):
                raise FlashGoneError(f"{self._link.description} hangs; pull its plug.")
        finally:
            with self._counting:
                self._callers -= 1
        try:
            yield
        finally:
            self._lock.release()

    def _take_turn(self) -> bool:
        """One round of the thread; whether there is to be another."""
        if self._callers:
            self._closing.wait(0.001)
            return True
        with self._lock:
            self._tend_once(_TEND_S)
        return not isinstance(self._failure, FlashGoneError)

    def _tend_once(self, timeout_s: float) -> None:
        """Reads what is there; nothing is raised, all is kept for the next call."""
        if isinstance(self._failure, FlashGoneError):
            return
        try:
            for _ in range(_READS):
                if not self._link.tend(timeout_s):
                    break
                timeout_s = 0.0
        except FlashError as error:
            self._failure = error
        except Exception as error:
            log.exception("%s: tending has failed", self._link.description)
            self._failure = FlashGoneError(f"{self._link.description} has failed: {error!r}; start again.")
        self._collect()

    def _collect(self) -> None:
        """EVENTs to edges, and what the device has said unasked."""
        link = self._link
        while link.events:
            event = link.events.popleft()
            if link.clock is not None and link.clock.fit.ready:
                edge = self._log.edge(event, link.clock)
                if edge is not None:
                    self._edges.append(edge)
        if link.restarted and not self._needs_hello:
            self._needs_hello = True
            self._log.reset()
        trouble = link.take_trouble()
        if trouble is not None and not isinstance(self._failure, FlashGoneError):
            self._failure = trouble
            self._running = None
        self._watch_train()

    def _watch_train(self) -> None:
        """A device that ends its train says so once; where that was lost, its next STAT says it again."""
        stat = self._link.stat
        if self._running is None or stat is None:
            return
        taken, end_s = self._running
        newer = (stat.tick - taken.tick) % (1 << 64) < 1 << 63
        if self._clock.now_s() > end_s - _END_SLACK_S:
            self._running = None
        elif newer and stat.state != State.TRAIN:
            self._running = None
            self._failure = self._failure or FlashError(
                f"{self._link.description} has ended its train by itself after {stat.pulses - taken.pulses} "
                "flashes; it heard nothing from this program for a while. Start again."
            )

    def _raise_failure(self) -> None:
        if self._closed:
            raise FlashGoneError(f"{self._url} has been closed; open it again.")
        failure = self._failure
        if failure is None:
            return
        if not isinstance(failure, FlashGoneError):
            self._failure = None  # said once: the device is there, dark, and can be told to start again
        raise failure

    def _stop(self, tries: int) -> bool:
        self._running = None
        try:
            if self._link.hello is None:
                self._link.send(Stop(), flush=True)
                return False
            answer = self._link.ask(Stop(), tries)
        except FlashGoneError as error:
            log.warning("%s", error)
            return False
        finally:
            self._collect()
        return isinstance(answer, Stat) and answer.state in (State.IDLE, State.SAFE) and answer.level == 0


def _serve(flash: weakref.ref[FirmwareFlash], closing: threading.Event) -> None:
    """The thread. Holds no reference between its rounds, so that a forgotten flash ends it."""
    while not closing.is_set():
        strong = flash()
        if strong is None or not strong._take_turn():
            return
        del strong


def _abandon(transport: ByteTransport) -> None:
    """A last word to a device whose flash nobody has closed."""
    try:
        transport.write(b"\0" + encode(Stop(), 0xFFFF))
    except FlashError as error:
        log.warning("%s", error)
    transport.close()
