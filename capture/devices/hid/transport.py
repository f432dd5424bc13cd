"""HID reports out and in, over the PyPI package `hidapi`; which devices there are, and which one is meant.

`hidapi` installs a module `hid`, and on Linux also `hidraw`, which is the one to use there: `hid` goes
through libusb, detaches the kernel's driver and needs other permissions. The PyPI package `hid` is something
else and hides it. What the drivers do: `write` to a device that was pulled out gives -1 and raises nothing,
`read` raises OSError, opening without permission raises OSError("open failed") and does not say why.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

from capture.errors import FlashError, FlashGoneError

#: The longest report of the devices here, with its id.
_LONGEST_REPORT = 65


class HidTransport(Protocol):
    """A HID device that has been opened. One thread at a time.

    Reports go out with their id first, 0 where the device has no ids; they come in as the device sends them:
    with the id where there are ids, without where there are none.
    """

    @property
    def address(self) -> HidAddress:
        """Which device it is."""

    def write(self, report: bytes) -> None:
        """Sends an output report.

        Raises:
            FlashGoneError: The device is not there any more.
        """

    def read(self, timeout_s: float) -> bytes:
        """The next input report; empty when none comes in time.

        Raises:
            FlashGoneError: The device is not there any more.
        """

    def send_feature(self, report: bytes) -> None:
        """Sets a feature report.

        Raises:
            FlashGoneError: The device is not there any more, or refuses the report.
        """

    def get_feature(self, report_id: int, length: int) -> bytes:
        """A feature report, of at most `length` bytes.

        Raises:
            FlashGoneError: The device is not there any more, or has no such report.
        """

    def close(self) -> None:
        """Lets go of it; harmless when repeated. Never raises."""


@dataclass(frozen=True, kw_only=True)
class HidAddress:
    """A device that is plugged in, as enumeration describes it without opening it.

    Attributes:
        path: By which the system opens it.
        vendor_id: Of USB.
        product_id: Of USB.
        serial: Of USB; empty = has none.
        product: Of USB; empty = has none.
        usage_page: Of its first collection; 0 = not known.
    """

    path: str
    vendor_id: int
    product_id: int
    serial: str = ""
    product: str = ""
    usage_page: int = 0

    @property
    def description(self) -> str:
        """For messages: product, serial number, path."""
        name = self.product or f"{self.vendor_id:04x}:{self.product_id:04x}"
        return f"{name} {self.serial} at {self.path}" if self.serial else f"{name} at {self.path}"


def find_devices(
    vendor_id: int, product_ids: Collection[int], usage_page: int | None = None
) -> list[HidAddress]:
    """What is plugged in, by path; opens nothing.

    Args:
        vendor_id: Of USB; 0 = any.
        product_ids: Of USB; empty = any.
        usage_page: Wanted where the system tells it.

    Raises:
        FlashError: `hidapi` is not installed.
    """
    found = {}
    for entry in _hidapi().enumerate(vendor_id, 0):
        address = HidAddress(
            path=os.fsdecode(entry["path"]),
            vendor_id=entry["vendor_id"],
            product_id=entry["product_id"],
            serial=entry.get("serial_number") or "",
            product=entry.get("product_string") or "",
            usage_page=entry.get("usage_page") or 0,
        )
        if product_ids and address.product_id not in product_ids:
            continue
        if usage_page is None or address.usage_page in (0, usage_page):
            found[address.path] = address
    return sorted(found.values(), key=lambda address: address.path)


def choose_device(
    devices: Sequence[HidAddress], *, scheme: str, kind: str, serial: str | None, path: str | None
) -> HidAddress:
    """The one that is meant.

    Args:
        devices: That are plugged in and of the right kind.
        scheme: Of the URL, for messages.
        kind: What a person calls it, for messages.
        serial: As the URL gives it; None = not given.
        path: Likewise.

    Raises:
        FlashError: None, or more than one; the message lists them.
    """
    chosen = [
        device
        for device in devices
        if (serial is None or device.serial == serial) and (path is None or device.path == path)
    ]
    if len(chosen) == 1:
        return chosen[0]
    listed = "; ".join(device.description for device in devices)
    if not devices:
        raise FlashError(
            f"No {kind} is plugged in; plug it in, and check with `lsusb` that the system sees it."
        )
    if chosen:
        raise FlashError(
            f"There are {len(chosen)} devices of the kind {kind} ({listed}); say which one with "
            f"{scheme}:serial=... or {scheme}:path=..."
        )
    wanted = f"serial={serial}" if path is None else f"path={path}"
    raise FlashError(f"No {kind} has {wanted}; plugged in: {listed}.")


def device_url(scheme: str, device: HidAddress) -> str:
    """The URL that opens this device and no other."""
    return f"{scheme}:serial={device.serial}" if device.serial else f"{scheme}:path={device.path}"


def udev_rule(vendor_id: int, product_id: int) -> str:
    """The line in /etc/udev/rules.d/70-relight.rules that lets who sits at the machine open the device."""
    return (
        f'SUBSYSTEM=="hidraw", ATTRS{{idVendor}}=="{vendor_id:04x}", '
        f'ATTRS{{idProduct}}=="{product_id:04x}", TAG+="uaccess"'
    )


def open_device(address: HidAddress) -> HidApiTransport:
    """Opens a device.

    Raises:
        FlashGoneError: It is not there any more.
        FlashError: No permission (the message has the udev rule), in use, or `hidapi` is not installed.
    """
    device = _hidapi().device()
    try:
        device.open_path(os.fsencode(address.path))
    except OSError as error:
        raise _open_error(address, error) from error
    return HidApiTransport(device, address)


class HidApiTransport:
    """A `HidTransport` on a device of the module `hidraw` or `hid`."""

    def __init__(self, device: Any, address: HidAddress) -> None:
        """Takes over an opened `hid.device`."""
        self._device = device
        self._address = address

    @property
    def address(self) -> HidAddress:
        """Which device it is."""
        return self._address

    def write(self, report: bytes) -> None:
        """Sends an output report."""
        try:
            sent = self._device.write(report)
        except (OSError, ValueError) as error:
            raise self._gone(error) from error
        if sent < 0:
            raise self._gone()

    def read(self, timeout_s: float) -> bytes:
        """The next input report; empty when none comes in time."""
        # 0 would wait for ever; a millisecond is the shortest wait there is.
        try:
            return bytes(self._device.read(_LONGEST_REPORT, max(1, round(timeout_s * 1000))))
        except (OSError, ValueError) as error:
            raise self._gone(error) from error

    def send_feature(self, report: bytes) -> None:
        """Sets a feature report."""
        try:
            sent = self._device.send_feature_report(report)
        except (OSError, ValueError) as error:
            raise self._gone(error) from error
        if sent < 0:
            raise self._gone()

    def get_feature(self, report_id: int, length: int) -> bytes:
        """A feature report, of at most `length` bytes."""
        try:
            return bytes(self._device.get_feature_report(report_id, length))
        except (OSError, ValueError) as error:
            raise self._gone(error) from error

    def close(self) -> None:
        """Lets go of it."""
        try:
            self._device.close()
        except (OSError, ValueError):  # it was gone before
            return

    def _gone(self, error: Exception | None = None) -> FlashGoneError:
        detail = f" ({error})" if error and str(error) else ""
        return FlashGoneError(
            f"{self._address.description} does not answer any more{detail}; check its cable and start again."
        )


def _hidapi() -> ModuleType:
    for name in ("hidraw", "hid") if sys.platform == "linux" else ("hid",):
        try:
            module = importlib.import_module(name)
        except ImportError:
            continue
        if hasattr(module, "device") and hasattr(module, "enumerate"):
            return module
    raise FlashError(
        "Lamps on USB HID need the package hidapi (pip install hidapi); the package named hid is another one "
        "and must be uninstalled."
    )


def _open_error(address: HidAddress, error: OSError) -> FlashError:
    if os.path.isabs(address.path) and address.path.startswith("/dev/"):
        if not os.path.exists(address.path):
            return FlashGoneError(f"{address.description} is not plugged in any more; plug it in again.")
        if not os.access(address.path, os.R_OK | os.W_OK):
            return FlashError(
                f"You may not open {address.description}: put the line "
                f"{udev_rule(address.vendor_id, address.product_id)} into "
                "/etc/udev/rules.d/70-relight.rules, run `udevadm control --reload`, and plug it in again."
            )
    return FlashError(
        f"{address.description} cannot be opened ({error}); close other programs that use it, or plug it in "
        "again."
    )
