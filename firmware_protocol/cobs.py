"""Consistent overhead byte stuffing: bytes without zeros, so that a zero can end a frame.

Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.
"""

from firmware_protocol.errors import ProtocolError

_FULL_BLOCK = 0xFF
"""Code of a block of 254 bytes after which no zero is implied."""


def stuff(data: bytes) -> bytes:
    """`data` without zero bytes, at most one byte in 254 longer; the delimiter is not added."""
    out = bytearray()
    block = bytearray()
    open_block = True
    for byte in data:
        open_block = True
        if byte:
            block.append(byte)
        if not byte or len(block) == _FULL_BLOCK - 1:
            out.append(len(block) + 1)
            out += block
            # A full block implies no zero: unless data ends in one, nothing is left to write after it.
            open_block = not byte
            block.clear()
    if open_block:
        out.append(len(block) + 1)
        out += block
    return bytes(out)


def unstuff(stuffed: bytes) -> bytes:
    """The bytes that `stuff` was given.

    Raises:
        ProtocolError: A zero inside, or a code byte that points past the end.
    """
    if 0 in stuffed:
        raise ProtocolError(f"zero byte at {stuffed.index(0)} inside stuffed data; split at the zeros first")
    out = bytearray()
    position = 0
    while position < len(stuffed):
        code = stuffed[position]
        end = position + code
        if end > len(stuffed):
            raise ProtocolError(
                f"code byte {code} at {position} points {end - len(stuffed)} past the end of the frame"
            )
        out += stuffed[position + 1 : end]
        position = end
        if code != _FULL_BLOCK and position < len(stuffed):
            out.append(0)
    return bytes(out)
