"""CRC-16/MCRF4XX: the checksum at the end of every frame.

Polynomial x¹⁶ + x¹² + x⁵ + 1, reflected (0x8408), initial value 0xFFFF, nothing xored at the end: check value
0x6F91 over the ASCII digits "123456789". Klipper and MAVLink use the same one, so every microcontroller has
code for it. In a body as short as this protocol's it detects every error of up to three bits and every burst
of up to 16.
"""


def _table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x8408 if byte & 1 else 0)
        table.append(byte)
    return tuple(table)


_TABLE = _table()


def crc16_mcrf4xx(data: bytes, crc: int = 0xFFFF) -> int:
    """Checksum of `data`; pass the result back as `crc` to go on over the next piece.

    Over a message followed by its own checksum (low byte first) the result is 0, which is how a receiver
    checks it without knowing where the message ends.
    """
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc
