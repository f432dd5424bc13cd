"""The messages: frozen dataclasses whose annotations are their layout on the wire, in order, little-endian.

A message that breaks a limit cannot be built, so none can be sent, and none comes out of the decoder.
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass, fields
from enum import IntEnum, IntFlag
from functools import cache
from typing import Annotated, ClassVar, Self, get_type_hints

from firmware_protocol.crc import crc16_mcrf4xx
from firmware_protocol.errors import ProtocolError
from firmware_protocol.limits import MAX_ON_MS, MIN_PERIOD_US, PROTOCOL_MAJOR, PROTOCOL_MINOR

U8 = Annotated[int, "B"]
U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
U64 = Annotated[int, "Q"]
Text24 = Annotated[str, "24s"]
"""ASCII without zeros, padded with zeros to 24 bytes."""


class Capability(IntFlag):
    """What a device can do beyond switching its light (bits of `Hello.capabilities`)."""

    SCHEDULE = 1
    """Runs a TRAIN by its own clock."""
    DIMMABLE = 2
    """`level` between off and full means something."""
    FEEDBACK = 4
    """EVENT ticks are measured at the light, not at the pin."""


class State(IntEnum):
    """What the light is doing (`Stat.state`)."""

    IDLE = 0
    SET = 1
    TRAIN = 2
    SAFE = 3
    """Off after a lost heartbeat or a watchdog: stays off until the next SET or TRAIN."""


class Edge(IntEnum):
    """Which way the light went (`Event.edge`)."""

    OFF = 0
    ON = 1


class ErrorCode(IntEnum):
    """Why a device did not do as told (`Err.code`)."""

    VERSION = 1
    UNKNOWN_TYPE = 2
    LENGTH = 3
    OUT_OF_RANGE = 4
    STALE_NONCE = 5
    """The command was meant for the device before its last reset: say HELLO again."""
    LATE = 6
    """The train's first edge has passed."""
    RATE = 7
    """One more flash would make more than three in one second."""
    HEARTBEAT = 8
    """Nothing came from the host for 1.5 s; the light is off. Not an answer: its `refused_seq` is 0."""
    UNSUPPORTED = 9
    """The device does not have the capability that the command needs."""


@dataclass(frozen=True)
class Message:
    """Base of all messages: packing and the checks that the fields' own types ask for."""

    TYPE: ClassVar[int] = 0

    def __post_init__(self) -> None:
        for name, code in LAYOUTS[self.TYPE]:
            value = getattr(self, name)
            if code == "24s":
                _check_text(type(self).__name__, name, value)
                continue
            limit = (1 << 8 * struct.calcsize(code)) - 1
            if not 0 <= value <= limit:
                raise ProtocolError(f"{type(self).__name__}.{name} is {value}; the wire carries 0..{limit}")

    @classmethod
    def payload_bytes(cls) -> int:
        """Length of the payload, fixed for each type."""
        return _STRUCTS[cls.TYPE].size

    def pack(self) -> bytes:
        """The payload."""
        values = (value.encode("ascii") if isinstance(value, str) else value for value in astuple(self))
        return _STRUCTS[self.TYPE].pack(*values)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message that packed into `payload`.

        Raises:
            ProtocolError: Wrong length, text that is not ASCII, or a field beyond its limit.
        """
        if len(payload) != cls.payload_bytes():
            raise ProtocolError(
                f"{cls.__name__} has a payload of {cls.payload_bytes()} bytes, not of {len(payload)}"
            )
        return cls(*(_field(value) for value in _STRUCTS[cls.TYPE].unpack(payload)))


@dataclass(frozen=True)
class Hello(Message):
    """Who is there. The host asks with it; the device answers with its own."""

    TYPE: ClassVar[int] = 0x01

    protocol_major: U8
    protocol_minor: U8
    schema_crc: U16
    """`schema_crc()` of the sender: differs when the two were built from different layouts."""
    boot_nonce: U32
    """Drawn by the device at every start; 0 from the host."""
    tick_hz: U32
    """Rate of the device's clock; 0 from the host."""
    capabilities: U32
    """Bits of `Capability`."""
    name: Text24
    """Firmware or host software with its version, for a person to read."""

    @classmethod
    def from_host(cls, name: str) -> Hello:
        """The question that the host sends."""
        return cls(PROTOCOL_MAJOR, PROTOCOL_MINOR, schema_crc(), 0, 0, 0, name)


@dataclass(frozen=True)
class Ping(Message):
    """Heartbeat and time query."""

    TYPE: ClassVar[int] = 0x02

    t1_host_us: U64
    """Host clock when sent; the device returns it untouched."""


@dataclass(frozen=True)
class Pong(Message):
    """Answer to PING, with what a clock fit needs."""

    TYPE: ClassVar[int] = 0x03

    boot_nonce: U32
    t1_host_us: U64
    t2_tick: U64
    """Device clock when the PING's delimiter arrived."""
    t3_tick: U64
    """Device clock when the PONG went out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.t3_tick < self.t2_tick:
            raise ProtocolError(f"Pong.t3_tick {self.t3_tick} is before its t2_tick {self.t2_tick}")


@dataclass(frozen=True)
class Set(Message):
    """Light on at `level` now, and off again after `ttl_ms` without another word."""

    TYPE: ClassVar[int] = 0x04

    boot_nonce: U32
    level: U16
    ttl_ms: U16

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ttl_ms > MAX_ON_MS:
            raise ProtocolError(f"Set.ttl_ms is {self.ttl_ms}; the light may stay on for {MAX_ON_MS} ms")


@dataclass(frozen=True)
class Train(Message):
    """`count` flashes by the device's own clock: on at t0 + k period, off `on_us` later."""

    TYPE: ClassVar[int] = 0x05

    boot_nonce: U32
    t0_tick: U64
    period_us: U32
    on_us: U32
    count: U16
    level: U16

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.period_us < MIN_PERIOD_US:
            raise ProtocolError(
                f"Train.period_us is {self.period_us}; three flashes a second at most need {MIN_PERIOD_US}"
            )
        if not 0 < self.on_us <= MAX_ON_MS * 1000:
            raise ProtocolError(f"Train.on_us is {self.on_us}; it must be 1..{MAX_ON_MS * 1000}")
        if self.count == 0:
            raise ProtocolError("Train.count is 0; send STOP to end a train")


@dataclass(frozen=True)
class Stop(Message):
    """Light off, train dropped. Carries no nonce: it is always obeyed."""

    TYPE: ClassVar[int] = 0x06


@dataclass(frozen=True)
class Stat(Message):
    """State and counters: the answer to SET, TRAIN and STOP, and once a second unasked."""

    TYPE: ClassVar[int] = 0x07

    boot_nonce: U32
    tick: U64
    state: U8
    """One of `State`."""
    level: U16
    """What the light is at now."""
    pulses: U32
    """Rising edges since start."""
    crc_errors: U32
    framing_errors: U32
    heartbeats_lost: U16

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_member("Stat.state", self.state, State)


@dataclass(frozen=True)
class Event(Message):
    """An edge of the light, when it happened. Sent unasked."""

    TYPE: ClassVar[int] = 0x08

    boot_nonce: U32
    tick: U64
    edge: U8
    """One of `Edge`."""
    pulse: U32
    """Which rising edge since start this pulse began with, counted from 1."""
    level: U16

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_member("Event.edge", self.edge, Edge)


@dataclass(frozen=True)
class Err(Message):
    """The device did not do as told, and why."""

    TYPE: ClassVar[int] = 0x09

    code: U8
    """One of `ErrorCode`; a newer device may send codes that are not listed here."""
    refused_seq: U16
    limit: U32
    """The limit that was broken, in the unit of the field; 0 where there is none."""


MESSAGE_TYPES: dict[int, type[Message]] = {
    cls.TYPE: cls for cls in (Hello, Ping, Pong, Set, Train, Stop, Stat, Event, Err)
}


def _layout(cls: type[Message]) -> tuple[tuple[str, str], ...]:
    hints = get_type_hints(cls, include_extras=True)
    return tuple((field.name, hints[field.name].__metadata__[0]) for field in fields(cls))


LAYOUTS = {number: _layout(cls) for number, cls in MESSAGE_TYPES.items()}
"""Per type the names of its fields, in order, with their `struct` codes."""

_STRUCTS = {
    number: struct.Struct("<" + "".join(code for _, code in layout)) for number, layout in LAYOUTS.items()
}


@cache
def schema() -> str:
    """Every message and its fields as one line of text each: what both sides must agree on."""
    lines = []
    for number, cls in sorted(MESSAGE_TYPES.items()):
        layout = " ".join(f"{name}:{code}" for name, code in LAYOUTS[number])
        lines.append(f"{number:02x} {cls.__name__.upper()} {layout}".rstrip())
    return "\n".join(lines) + "\n"


@cache
def schema_crc() -> int:
    """CRC-16/MCRF4XX of `schema()`; firmware has it as a constant, and HELLO compares the two."""
    return crc16_mcrf4xx(schema().encode("ascii"))


def _field(value: int | bytes) -> int | str:
    if isinstance(value, int):
        return value
    text = value.rstrip(b"\0")
    if not text.isascii():
        raise ProtocolError(f"text {text!r} is not ASCII")
    return text.decode("ascii")


def _check_text(message: str, name: str, value: str) -> None:
    if not value.isascii() or "\0" in value or len(value) > 24:
        raise ProtocolError(
            f"{message}.{name} is {value!r}; it must be at most 24 ASCII characters, no zeros"
        )


def _check_member(name: str, value: int, members: type[IntEnum]) -> None:
    if value not in tuple(members):
        known = ", ".join(f"{member.value} {member.name}" for member in members)
        raise ProtocolError(f"{name} is {value}; known are {known}")
