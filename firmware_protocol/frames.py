"""Frames on the wire: one message each, checked, delimited, found again after any garbage.

    COBS( u8 version | u8 type | u16 seq | payload | u16 CRC ) 00

The decoder is fed whatever the port gave, in pieces of any size. It holds at most one frame, never blocks,
never raises on input, and after any damage is in step again at the next delimiter.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum

from firmware_protocol.cobs import stuff, unstuff
from firmware_protocol.crc import crc16_mcrf4xx
from firmware_protocol.errors import ProtocolError
from firmware_protocol.limits import CRC_BYTES, HEADER_BYTES, MAX_WIRE_BYTES, WIRE_VERSION
from firmware_protocol.messages import MESSAGE_TYPES, Message

_DELIMITER = 0


@dataclass(frozen=True)
class Packet:
    """A message and the number it came with: an answer carries that of its command, 0 means unasked."""

    seq: int
    message: Message


class FaultReason(Enum):
    """Why the bytes between two delimiters were no packet."""

    OVERSIZED = "oversized"
    """More bytes than the longest frame without a delimiter: boot noise, a wrong baud rate."""
    FRAMING = "framing"
    """Not COBS, or too short for a header and a checksum."""
    CRC = "crc"
    VERSION = "version"
    UNKNOWN_TYPE = "unknown_type"
    PAYLOAD = "payload"
    """Intact, but of the wrong length or with a field beyond its limit."""


@dataclass(frozen=True)
class Fault:
    """Bytes that were no packet. `seq` is known where the frame was intact, so that it can be refused."""

    reason: FaultReason
    detail: str
    seq: int | None = None


def encode(message: Message, seq: int) -> bytes:
    """The frame that carries `message`, delimiter included.

    Args:
        message: What to send.
        seq: 1..65535 for a command, that of the command for its answer, 0 for what was not asked for.

    Raises:
        ProtocolError: `seq` does not fit.
    """
    if not 0 <= seq <= 0xFFFF:
        raise ProtocolError(f"seq is {seq}; the wire carries 0..65535")
    body = bytes((WIRE_VERSION, message.TYPE)) + seq.to_bytes(2, "little") + message.pack()
    return stuff(body + crc16_mcrf4xx(body).to_bytes(2, "little")) + bytes((_DELIMITER,))


class Decoder:
    """Packets and faults from a stream of bytes.

    Attributes:
        faults: How many of each kind there have been, for the link's statistics.
        packets: How many good ones.
    """

    def __init__(self) -> None:
        self.faults: Counter[FaultReason] = Counter()
        self.packets = 0
        self._pending = bytearray()
        self._overflowed = False

    def feed(self, data: bytes) -> list[Packet | Fault]:
        """What the bytes up to the last delimiter in `data` complete; the rest waits for the next call."""
        found: list[Packet | Fault] = []
        *finished, rest = bytes(data).split(bytes((_DELIMITER,)))
        for chunk in finished:
            self._collect(chunk)
            outcome = self._complete()
            if outcome is not None:
                found.append(outcome)
        self._collect(rest)
        return found

    def _collect(self, chunk: bytes) -> None:
        room = MAX_WIRE_BYTES - 1 - len(self._pending)
        self._overflowed |= len(chunk) > room
        self._pending += chunk[:room]

    def _complete(self) -> Packet | Fault | None:
        stuffed, self._pending = bytes(self._pending), bytearray()
        overflowed, self._overflowed = self._overflowed, False
        if not stuffed:  # a delimiter alone flushes the line; it says nothing
            return None
        if overflowed:
            outcome: Packet | Fault = Fault(
                FaultReason.OVERSIZED, f"more than {MAX_WIRE_BYTES} bytes without a delimiter"
            )
        else:
            outcome = decode_frame(stuffed)
        if isinstance(outcome, Fault):
            self.faults[outcome.reason] += 1
        else:
            self.packets += 1
        return outcome


def decode_frame(stuffed: bytes) -> Packet | Fault:
    """The packet in the bytes between two delimiters, or why there is none."""
    try:
        body = unstuff(stuffed)
    except ProtocolError as error:
        return Fault(FaultReason.FRAMING, str(error))
    if len(body) < HEADER_BYTES + CRC_BYTES:
        return Fault(FaultReason.FRAMING, f"{len(body)} bytes are too few for a header and a checksum")
    if crc16_mcrf4xx(body) != 0:
        return Fault(FaultReason.CRC, f"checksum of {len(body)} bytes does not match")
    version, number = body[0], body[1]
    seq = int.from_bytes(body[2:HEADER_BYTES], "little")
    if version != WIRE_VERSION:
        return Fault(FaultReason.VERSION, f"wire version {version}; this codec speaks {WIRE_VERSION}", seq)
    if number not in MESSAGE_TYPES:
        return Fault(FaultReason.UNKNOWN_TYPE, f"message type 0x{number:02x} is not known", seq)
    try:
        return Packet(seq, MESSAGE_TYPES[number].unpack(body[HEADER_BYTES:-CRC_BYTES]))
    except ProtocolError as error:
        return Fault(FaultReason.PAYLOAD, str(error), seq)
