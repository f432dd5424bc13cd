"""Serial ports that look like a board which may carry the firmware, told by their USB ids and never opened.

Vendor and product ids as their makers assign them: Arduino 2341 and 2a03, WCH 1a86, FTDI 0403, Silicon Labs
10c4, Raspberry Pi 2e8a. A bridge chip (CH340, FT232, CP210x) sits on many things that are no flash; only the
handshake tells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

#: (vendor, product) -> what it is; product None = all of that vendor.
_KNOWN: dict[tuple[int, int | None], str] = {
    (0x2341, 0x0043): "Arduino Uno R3",
    (0x2341, 0x0001): "Arduino Uno",
    (0x2341, 0x0243): "Arduino Uno R3",
    (0x2341, None): "Arduino",
    (0x2A03, 0x0043): "Arduino Uno R3",
    (0x2A03, None): "Arduino",
    (0x1A86, 0x7523): "CH340 (Arduino Nano, many others)",
    (0x1A86, 0x5523): "CH341",
    (0x1A86, 0x55D4): "CH9102",
    (0x0403, 0x6001): "FT232R (Arduino Nano, many others)",
    (0x0403, 0x6015): "FT231X",
    (0x10C4, 0xEA60): "CP210x",
    (0x2E8A, None): "Raspberry Pi Pico",
}


class UsbPort(Protocol):
    """What pyserial's `list_ports` says of a port."""

    device: str
    vid: int | None
    pid: int | None
    serial_number: str | None
    product: str | None


@dataclass(frozen=True, kw_only=True)
class Board:
    """A port that may be the flash.

    Attributes:
        url: That opens it: its path.
        name: For a person.
        vendor_id: USB.
        product_id: USB.
        serial_number: USB; empty where the chip has none, as a CH340.
    """

    url: str
    name: str
    vendor_id: int
    product_id: int
    serial_number: str


def find_boards(ports: Iterable[UsbPort] | None = None) -> list[Board]:
    """What is plugged in, by path.

    Args:
        ports: Instead of the machine's own, for tests.
    """
    found = []
    for port in _system_ports() if ports is None else ports:
        if port.vid is None or port.pid is None:
            continue
        name = _KNOWN.get((port.vid, port.pid)) or _KNOWN.get((port.vid, None))
        if name is None:
            continue
        found.append(
            Board(
                url=port.device,
                name=f"{name}: {port.product}" if port.product and port.product not in name else name,
                vendor_id=port.vid,
                product_id=port.pid,
                serial_number=port.serial_number or "",
            )
        )
    return sorted(found, key=lambda board: board.url)


def usb_details(path: str) -> dict[str, Any]:
    """What USB says of the port at `path`: plain values; empty when it is none, or not on USB."""
    for port in _system_ports():
        if port.device == path and port.vid is not None and port.pid is not None:
            return {
                "usb": f"{port.vid:04x}:{port.pid:04x}",
                "product": port.product or "",
                "serial_number": port.serial_number or "",
            }
    return {}


def _system_ports() -> list[Any]:
    from serial.tools import list_ports

    return list(list_ports.comports())
