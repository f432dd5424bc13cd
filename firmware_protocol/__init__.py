"""The wire protocol between the host and the flash: standard library only, no port, no thread, no clock.

`PROTOCOL.md` is the specification, `vectors.json` its golden examples, for this codec and for firmware alike.
"""

from firmware_protocol.errors import ProtocolError
from firmware_protocol.frames import Decoder, Fault, FaultReason, Packet, encode
from firmware_protocol.messages import (
    MESSAGE_TYPES,
    Err,
    Event,
    Hello,
    Message,
    Ping,
    Pong,
    Set,
    Stat,
    Stop,
    Train,
)

__all__ = [
    "MESSAGE_TYPES",
    "Decoder",
    "Err",
    "Event",
    "Fault",
    "FaultReason",
    "Hello",
    "Message",
    "Packet",
    "Ping",
    "Pong",
    "ProtocolError",
    "Set",
    "Stat",
    "Stop",
    "Train",
    "encode",
]
