"""The flash with the reference firmware on a serial port: `/dev/ttyUSB0`, `COM3`, `hwgrep://2341:0043`, ...

    port.py    pyserial's port as a line that the firmware's flash can use
    boards.py  which ports look like a board that may carry the firmware, without opening them

What is said over the line is in `capture.devices.firmware_flash`.
"""

from __future__ import annotations

from capture.devices.bench import Bench
from capture.devices.firmware_flash.flash import FirmwareFlash, open_firmware_flash
from capture.devices.serial_flash.boards import find_boards
from capture.devices.serial_flash.port import SerialLine


def open_flash(rest: str, bench: Bench) -> FirmwareFlash:
    """Opens a port and shakes hands; half a second, or three when opening it resets the board.

    Args:
        rest: A path, `COM3`, or a URL of pyserial's: `hwgrep://`, `socket://`, `rfc2217://`, `spy://`, ...
        bench: Its clock is the host's.

    Raises:
        FlashError: No such port, no permission, in use, nothing answers, or not this firmware.
    """
    line = SerialLine(rest, bench.clock)
    return open_firmware_flash(line, bench, url=rest, back_end="serial", details=line.details)


def list_flashes() -> list[str]:
    """URLs of the ports with a board that may be the flash. None is opened: that would reset the board."""
    return [board.url for board in find_boards()]
