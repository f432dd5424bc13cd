"""The line to our own firmware over HID: `hid-firmware:`, `hid-firmware:serial=...`.

The byte stream of firmware_protocol in reports of 64 bytes both ways, without report ids. A report holds
whole frames, one after the other, and zeros to its end: in the stream a zero is a delimiter, and delimiters
in a row say nothing. A frame has at most 64 bytes with its delimiter, so each fits, and a lost report costs
only the frames that it held. USB's own checksum and repeats are below it.

The device is known by its usage page ff52 and usage 1, and by the product string "relight flash"; it has no
vendor's number of its own.
"""

from __future__ import annotations

from capture.devices.bench import Bench
from capture.devices.firmware_flash.flash import open_firmware_flash
from capture.devices.flash import FlashDevice
from capture.devices.hid.transport import (
    HidAddress,
    HidTransport,
    choose_device,
    device_url,
    find_devices,
    open_device,
)
from capture.devices.url_options import parse_options
from capture.errors import FlashError

USAGE_PAGE = 0xFF52
PRODUCT = "relight flash"
REPORT_BYTES = 64
_OPTIONS = {"serial": str, "path": str}


def open_flash(rest: str, bench: Bench) -> FlashDevice:
    """The flash of `hid-firmware:REST`; serial=... or path=... says which one, where there are several.

    Raises:
        FlashError: A setting is not understood, no such device, no permission, or not this firmware.
    """
    options = parse_options(rest, _OPTIONS, FlashError, scheme="hid-firmware")
    address = choose_device(
        find_firmware(),
        scheme="hid-firmware",
        kind="flash with our firmware on USB HID",
        serial=options.get("serial"),
        path=options.get("path"),
    )
    return open_firmware_flash(
        ReportLine(open_device(address)),
        bench,
        url=device_url("hid-firmware", address),
        back_end="hid-firmware",
        details={"serial": address.serial, "path": address.path},
    )


class ReportLine:
    """A `ByteTransport` in HID reports."""

    #: No pace of its own: a report is on the wire within a millisecond.
    seconds_per_byte = 0.0

    def __init__(self, transport: HidTransport) -> None:
        """Takes over an opened device."""
        self._transport = transport

    @property
    def description(self) -> str:
        """What a person calls it."""
        return self._transport.address.description

    def write(self, data: bytes) -> None:
        """Sends all of it, as few frames to a report as it takes that none is cut."""
        for report in to_reports(data):
            self._transport.write(b"\0" + report)

    def read(self, timeout_s: float) -> bytes:
        """The next report's bytes, zeros at its end and all; empty when none comes in time."""
        return self._transport.read(timeout_s)

    def close(self) -> None:
        """Lets go of it."""
        self._transport.close()


def to_reports(data: bytes) -> list[bytes]:
    """Stretches of a byte stream in reports of 64 bytes, cut after delimiters where there are any.

    Args:
        data: Frames with their delimiters; what is longer than a report without a delimiter (a line of text)
            is cut where the report is full.
    """
    reports, rest = [], bytes(data)
    while rest:
        size = len(rest)
        if size > REPORT_BYTES:
            size = rest.rfind(b"\0", 0, REPORT_BYTES) + 1 or REPORT_BYTES
        reports.append(rest[:size].ljust(REPORT_BYTES, b"\0"))
        rest = rest[size:]
    return reports


def find_firmware() -> list[HidAddress]:
    """The devices with our firmware that are plugged in."""
    return [
        device for device in find_devices(0, (), USAGE_PAGE) if device.product.lower().startswith(PRODUCT)
    ]


def list_flashes() -> list[str]:
    """URLs of the devices that are plugged in."""
    return [device_url("hid-firmware", device) for device in find_firmware()]
