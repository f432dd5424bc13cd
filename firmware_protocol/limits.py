"""What the wire carries and what the light may do; the firmware has constants of the same names.

The limits on the light are held twice: a message that breaks one cannot be built on the host, and a device
refuses it all the same (`ErrorCode.OUT_OF_RANGE`, `ErrorCode.RATE`).
"""

WIRE_VERSION = 1
"""First byte of every frame. Anything else is another protocol."""

PROTOCOL_MAJOR = 1
PROTOCOL_MINOR = 0

MAX_WIRE_BYTES = 64
"""A frame on the wire: COBS code byte, body, delimiter."""

HEADER_BYTES = 4
CRC_BYTES = 2

MAX_BODY_BYTES = MAX_WIRE_BYTES - 2
"""Header, payload and CRC, before stuffing: a body this short gains exactly one byte in COBS."""

MAX_PAYLOAD_BYTES = MAX_BODY_BYTES - HEADER_BYTES - CRC_BYTES

MAX_ON_MS = 250
"""The longest the light stays on, whatever was asked and whatever else has failed."""

MAX_RATE_HZ = 3
"""Most flashes in any one second: WCAG 2.3.1 and Ofcom both stop at three (photosensitive epilepsy)."""

MIN_PERIOD_US = -(-1_000_000 // MAX_RATE_HZ)
"""The shortest period that keeps `MAX_RATE_HZ`, rounded up: 333,334 µs."""

HEARTBEAT_TIMEOUT_MS = 1500
"""Without a valid frame from the host for this long, the device turns the light off and drops its train."""

FULL_LEVEL = 0xFFFF
"""`level` of the undimmed light; 0 is off."""
