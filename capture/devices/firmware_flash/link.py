"""Commands and answers over a line, after PROTOCOL.md: numbers, repeats, heartbeat, resets, counters.

    link = FirmwareLink(transport, clock)
    shake_hands(link)
    stat = link.ask(Stop())
    link.tend(0.02)             reads what comes, sends a PING when one is due

No thread in here: whoever holds the link tends it, and a wait for an answer does too. All waits go by the
clock that it was given.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from typing import Any

from capture.devices.bench import Clock
from capture.devices.firmware_flash.device_clock import DeviceClock
from capture.devices.firmware_flash.transport import ByteTransport
from capture.errors import FlashError, FlashGoneError, FlashResetError
from firmware_protocol import (
    Decoder,
    Err,
    Event,
    Hello,
    Message,
    Packet,
    Ping,
    Pong,
    Set,
    Stat,
    Stop,
    Train,
    encode,
)
from firmware_protocol.messages import ErrorCode

log = logging.getLogger(__name__)

#: The device repeats an answer whose command is repeated (PROTOCOL.md).
REPEAT_AFTER_S = 0.1
TRIES = 10
#: Less than a third of the device's 1.5 s, and no divisor of a second, so that it does not beat with flashes
#: once a second.
HEARTBEAT_S = 0.37
#: A device says something at least once a second.
SILENT_S = 3.0
_PING_FORGOTTEN_S = 2.0

_ANSWERS: dict[type[Message], type[Message]] = {
    Hello: Hello,
    Ping: Pong,
    Set: Stat,
    Train: Stat,
    Stop: Stat,
}


class FirmwareLink:
    """One line to one device. Not for two threads at once.

    Attributes:
        hello: What the device said of itself; None before the handshake.
        clock: Of the device; a new one after each reset.
        stat: The last STAT.
        events: EVENTs that nobody has taken, oldest first.
        restarted: The device has restarted since the handshake.
        heartbeat: Whether PINGs are sent as they come due.
    """

    def __init__(self, transport: ByteTransport, clock: Clock) -> None:
        """Takes the line as its own; sends nothing yet."""
        self.transport = transport
        self.clock: DeviceClock | None = None
        self.hello: Hello | None = None
        self.stat: Stat | None = None
        self.events: deque[Event] = deque()
        self.restarted = False
        self.heartbeat = False
        self.decoder = Decoder()
        self._clock = clock
        self._seq = 0
        self._pings: dict[int, tuple[Ping, float]] = {}
        self._next_ping_s = clock.now_s()
        self._heard_s = clock.now_s()
        self._waiting: dict[int, type[Message]] = {}
        self._answers: dict[int, Message] = {}
        self._trouble: FlashError | None = None
        self._counts: Counter[str] = Counter()

    @property
    def description(self) -> str:
        """Of the line."""
        return self.transport.description

    def now_s(self) -> float:
        """Host clock."""
        return self._clock.now_s()

    def accept(self, hello: Hello) -> None:
        """From now on the device is the one that said `hello`: its nonce, its clock."""
        self.hello = hello
        self.clock = DeviceClock(hello.tick_hz, self.transport.seconds_per_byte)
        self.restarted = False
        self.stat = None
        self._trouble = None
        self.events.clear()
        self._pings.clear()
        self._heard_s = self.now_s()

    def forget(self) -> None:
        """As before the handshake: no device, no heartbeat."""
        self.hello = None
        self.clock = None
        self.restarted = self.heartbeat = False

    def take_trouble(self) -> FlashError | None:
        """What the device has said unasked that must not go unheard: a reset, a lost heartbeat; once."""
        trouble, self._trouble = self._trouble, None
        return trouble

    def send(self, message: Message, *, flush: bool = False) -> int:
        """Sends a command and does not wait; its number."""
        seq = self._next_seq()
        self.transport.write((b"\0" if flush else b"") + encode(message, seq))
        return seq

    def ask(self, message: Message, tries: int = TRIES) -> Message:
        """Sends a command, again after each 100 ms without an answer, and gives back the answer.

        Raises:
            FlashError: The device refused it.
            FlashGoneError: There was no answer, or the line is not there any more.
            FlashResetError: The device has restarted.
        """
        seq = self._next_seq()
        wire = encode(message, seq)
        self._waiting[seq] = _ANSWERS[type(message)]
        try:
            for attempt in range(tries):
                if attempt:
                    self._counts["repeats"] += 1
                self.transport.write(b"\0" + wire if attempt else wire)
                answer = self._answer_within(seq, REPEAT_AFTER_S, by_nonce=not isinstance(message, Stop))
                if answer is not None:
                    break
            else:
                self._counts["unanswered"] += 1
                raise FlashGoneError(
                    f"{self.description} has not answered {tries} times "
                    f"{type(message).__name__.upper()} in {tries * REPEAT_AFTER_S:.1f} s; check its cable "
                    "and its power, then start again."
                )
        finally:
            self._waiting.pop(seq, None)
            self._answers.pop(seq, None)
        if isinstance(answer, Err):
            if answer.code == ErrorCode.STALE_NONCE:
                self._note_reset()
                raise self.take_trouble() or _reset_error(self.description)
            raise refusal(answer, message, self.description)
        return answer

    def ping(self) -> bool:
        """A round trip for the clock; whether the answer came within 100 ms."""
        self._send_ping()
        seq = self._seq
        end_s = self.now_s() + REPEAT_AFTER_S
        while seq in self._pings and self.now_s() < end_s:
            self.tend(end_s - self.now_s())
        return seq not in self._pings

    def tend(self, timeout_s: float) -> bool:
        """Sends a PING if one is due and reads what comes, for `timeout_s` at most; whether anything came.

        Raises:
            FlashGoneError: The line is not there any more, or the device has been silent for 3 s.
        """
        now_s = self.now_s()
        if self.heartbeat:
            if now_s >= self._next_ping_s:
                self._send_ping()
            timeout_s = min(timeout_s, max(0.0, self._next_ping_s - now_s))
        data = self.transport.read(max(0.0, timeout_s))
        arrived_s = self.now_s()
        for item in self.decoder.feed(data):
            if isinstance(item, Packet):
                self._hear(item, arrived_s)
        if self.heartbeat and not self._waiting and arrived_s - self._heard_s > SILENT_S:
            raise FlashGoneError(
                f"{self.description} has been silent for {arrived_s - self._heard_s:.1f} s; its light has "
                "gone out by itself. Check its cable and its power, then start again."
            )
        return bool(data)

    def report(self) -> dict[str, Any]:
        """Counters and the clock's fit: plain values for session.json."""
        faults = {reason.value: count for reason, count in sorted(self.decoder.faults.items(), key=str)}
        report: dict[str, Any] = {
            "packets": self.decoder.packets,
            "resyncs": sum(faults.values()),
            "faults": faults,
            "crc_errors": faults.get("crc", 0),
            "repeats": self._counts["repeats"],
            "unanswered": self._counts["unanswered"],
            "pings": self._counts["pings"],
            "pings_lost": self._counts["pings_lost"],
            "resets": self._counts["resets"],
        }
        if self.stat is not None:
            report["device_crc_errors"] = self.stat.crc_errors
            report["device_framing_errors"] = self.stat.framing_errors
            report["device_heartbeats_lost"] = self.stat.heartbeats_lost
        if self.clock is not None:
            report |= self.clock.report()
        return report

    def _next_seq(self) -> int:
        self._seq = self._seq % 0xFFFF + 1
        return self._seq

    def _answer_within(self, seq: int, timeout_s: float, by_nonce: bool) -> Message | None:
        end_s = self.now_s() + timeout_s
        while seq not in self._answers:
            left_s = end_s - self.now_s()
            if left_s <= 0:
                return None
            self.tend(left_s)
            if self.restarted and by_nonce and seq not in self._answers:
                raise self.take_trouble() or _reset_error(self.description)
        return self._answers[seq]

    def _send_ping(self) -> None:
        before_s = self.now_s()
        for seq, (_, sent_s) in list(self._pings.items()):
            if before_s - sent_s > _PING_FORGOTTEN_S:
                del self._pings[seq]
                self._counts["pings_lost"] += 1
        self._next_ping_s = before_s + HEARTBEAT_S
        ping = Ping(round(before_s * 1e6) % (1 << 64))
        seq = self._next_seq()
        self.transport.write(encode(ping, seq))
        self._pings[seq] = (ping, before_s)
        self._counts["pings"] += 1

    def _hear(self, packet: Packet, arrived_s: float) -> None:
        message = packet.message
        if isinstance(message, (Set, Train, Stop, Ping)) or (
            isinstance(message, Hello) and message.boot_nonce == 0
        ):
            return  # our own words: the line echoes
        self._heard_s = arrived_s
        if self.hello is not None and not isinstance(message, Err):
            nonce = getattr(message, "boot_nonce", 0)
            if nonce != self.hello.boot_nonce:
                self._note_reset()
                if self._waiting.get(packet.seq) is Stat and isinstance(message, Stat):
                    self._answers[packet.seq] = message  # a STOP's: SET and TRAIN carry the old nonce
                return
        if isinstance(message, Pong):
            self._take_pong(packet.seq, message, arrived_s)
        elif isinstance(message, Stat):
            self.stat = message
        elif isinstance(message, Event):
            self.events.append(message)
        elif isinstance(message, Err) and message.code == ErrorCode.HEARTBEAT and packet.seq == 0:
            self._trouble = FlashError(
                f"{self.description} has heard nothing from this program for {message.limit / 1000:.1f} s "
                "and has put its light out; the machine was too busy, or the cable loses bytes."
            )
        wanted = self._waiting.get(packet.seq)
        if wanted is not None and isinstance(message, (wanted, Err)):
            self._answers[packet.seq] = message

    def _take_pong(self, seq: int, pong: Pong, arrived_s: float) -> None:
        sent = self._pings.get(seq)
        if sent is None or sent[0].t1_host_us != pong.t1_host_us or self.clock is None:
            return
        del self._pings[seq]
        self.clock.add(pong, sent[1], arrived_s)

    def _note_reset(self) -> None:
        if not self.restarted:
            self._counts["resets"] += 1
            log.warning("%s has restarted", self.description)
            self._trouble = _reset_error(self.description)
        self.restarted = True


def _reset_error(description: str) -> FlashResetError:
    return FlashResetError(
        f"{description} has restarted by itself and its light is off; its supply may be too weak for the "
        "lamp. Start again."
    )


def refusal(err: Err, message: Message, description: str) -> FlashError:
    """What a device's ERR means to the user."""
    name = type(message).__name__.upper()
    reasons = {
        ErrorCode.VERSION: f"speaks another version of the protocol ({err.limit}); update the firmware",
        ErrorCode.UNKNOWN_TYPE: f"does not know {name}; update the firmware",
        ErrorCode.LENGTH: f"expects {err.limit} bytes of {name}; update the firmware",
        ErrorCode.OUT_OF_RANGE: f"refuses a value of {name}: its limit is {err.limit}",
        ErrorCode.LATE: "was told too late: the first flash was less than a millisecond away; start later",
        ErrorCode.RATE: f"refuses more than {err.limit} flashes in any one second, and any in the second "
        "after its start; start later",
        ErrorCode.HEARTBEAT: "had put its light out because nothing was heard from this program",
        ErrorCode.UNSUPPORTED: "cannot dim its light; use level 1",
    }
    known = {int(code): text for code, text in reasons.items()}
    return FlashError(f"{description} {known.get(err.code, f'refuses {name} with error {err.code}')}.")
