"""The USB line to a camera: control transfers through pyusb's libusb back end, and what goes wrong in words.

The `Device.ctrl_transfer` of pyusb claims the interface first. That must not be done on macOS, whose kernel
keeps a camera's interfaces to itself but lets requests on endpoint 0 pass; so its documented back end layer
(`usb.backend.IBackend`) is used.
"""

from __future__ import annotations

import array
import errno
import sys
from dataclasses import dataclass
from typing import Any, Protocol

import usb.core

from capture.errors import CameraError, CameraGoneError

_TIMEOUT_MS = 1000
_GET_DESCRIPTOR, _DEVICE_TO_HOST = 0x06, 0x80
_STRING = 0x03
_ENGLISH = 0x0409
_VIDEO, _VIDEO_CONTROL = 0x0E, 0x01  # bInterfaceClass, bInterfaceSubClass


class UsbBackend(Protocol):
    """The part of `usb.backend.IBackend` that is needed; devices and handles are the back end's own."""

    def enumerate_devices(self) -> Any:
        """Every device."""

    def get_device_descriptor(self, dev: Any) -> Any:
        """Has idVendor, idProduct, iProduct, iSerialNumber, bus, address."""

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        """Has bNumInterfaces."""

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        """Has bInterfaceNumber, bInterfaceClass, bInterfaceSubClass, extra_descriptors."""

    def open_device(self, dev: Any) -> Any:
        """A handle."""

    def close_device(self, dev_handle: Any) -> None:
        """Lets go."""

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        """Takes an interface."""

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        """Gives it back."""

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        """Bytes moved; `data` is an array of bytes, read into or written from."""


class StalledError(CameraError):
    """The camera refuses a request: it has no such control, or not in this state."""


def libusb() -> UsbBackend:
    """The libusb 1.0 of pyusb.

    Raises:
        CameraError: The library is not installed.
    """
    import usb.backend.libusb1

    backend: UsbBackend | None = usb.backend.libusb1.get_backend()
    if backend is None:
        how = {"darwin": "brew install libusb", "win32": "put libusb-1.0.dll on the PATH"}
        raise CameraError(
            "uvc: needs libusb 1.0, which is not installed; install it "
            f"({how.get(sys.platform, 'apt install libusb-1.0-0')}), or use v4l2: or opencv:."
        )
    return backend


@dataclass(frozen=True, kw_only=True)
class UsbCamera:
    """A camera that is plugged in, as its descriptors tell without opening it.

    Attributes:
        device: The back end's own.
        vendor: `idVendor`.
        product: `idProduct`.
        bus: Where it is plugged in.
        address: On the bus.
        product_string: Index of its name; 0 = none.
        serial_string: Index of its serial number; 0 = none.
        interface: Number of its first VideoControl interface.
        specific: The class-specific descriptors of that interface.
    """

    device: Any
    vendor: int
    product: int
    bus: int
    address: int
    product_string: int
    serial_string: int
    interface: int
    specific: bytes

    def __str__(self) -> str:
        return f"USB camera {self.vendor:04x}:{self.product:04x}"


def find_cameras(backend: UsbBackend) -> list[UsbCamera]:
    """The devices with a VideoControl interface."""
    cameras = []
    for device in backend.enumerate_devices():
        try:
            about = backend.get_device_descriptor(device)
            interface = _video_control_interface(backend, device)
        except (usb.core.USBError, NotImplementedError):
            continue  # a device that does not tell, a hub in trouble: not a camera that could be used
        if interface is not None:
            cameras.append(
                UsbCamera(
                    device=device,
                    vendor=about.idVendor,
                    product=about.idProduct,
                    bus=about.bus or 0,
                    address=about.address or 0,
                    product_string=about.iProduct,
                    serial_string=about.iSerialNumber,
                    interface=interface.bInterfaceNumber,
                    specific=bytes(interface.extra_descriptors),
                )
            )
    return cameras


def _video_control_interface(backend: UsbBackend, device: Any) -> Any:
    for index in range(backend.get_configuration_descriptor(device, 0).bNumInterfaces):
        interface = backend.get_interface_descriptor(device, index, 0, 0)
        if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (_VIDEO, _VIDEO_CONTROL):
            return interface
    return None


class UsbLink:
    """An opened device."""

    def __init__(self, backend: UsbBackend, device: UsbCamera, platform: str = sys.platform) -> None:
        """Opens it; nothing is claimed yet.

        Raises:
            CameraError: No permission, no driver that libusb can use, or it is gone.
        """
        self.device = device
        self._backend = backend
        self._platform = platform
        self._claimed: int | None = None
        self._handle: Any = None
        try:
            self._handle = backend.open_device(device.device)
        except (usb.core.USBError, NotImplementedError) as error:
            raise self._translated(error) from error

    def claim(self, interface: int) -> None:
        """Takes the interface whose controls are to be used, where the system wants that.

        Raises:
            CameraError: A driver or another program has it.
        """
        if self._platform == "darwin":
            return
        try:
            self._backend.claim_interface(self._handle, interface)
        except (usb.core.USBError, NotImplementedError) as error:
            raise self._translated(error) from error
        self._claimed = interface

    def read(self, request_type: int, request: int, value: int, index: int, length: int) -> bytes:
        """The data of a request to the host; may be shorter than asked.

        Raises:
            StalledError: The device refuses the request.
            CameraGoneError: It is not there any more.
            CameraError: It does not answer, or not by the rules.
        """
        data = array.array("B", bytes(length))
        return bytes(data[: self._transfer(request_type, request, value, index, data)])

    def write(self, request_type: int, request: int, value: int, index: int, data: bytes) -> None:
        """A request with data to the device; errors as `read`."""
        self._transfer(request_type, request, value, index, array.array("B", data))

    def _transfer(self, request_type: int, request: int, value: int, index: int, data: Any) -> int:
        if self._handle is None:
            raise CameraGoneError(f"The {self.device} is closed; open it again to use it.")
        try:
            return self._backend.ctrl_transfer(
                self._handle, request_type, request, value, index, data, _TIMEOUT_MS
            )
        except (usb.core.USBError, NotImplementedError) as error:
            raise self._translated(error) from error

    def text(self, index: int) -> str:
        """A string of the device; empty where it has none or does not say it."""
        if not index:
            return ""
        try:
            data = self.read(_DEVICE_TO_HOST, _GET_DESCRIPTOR, _STRING << 8 | index, _ENGLISH, 255)
        except CameraGoneError:
            raise
        except CameraError:
            return ""
        return data[2 : data[0]].decode("utf-16-le", "replace").strip() if len(data) >= 2 else ""

    def close(self) -> None:
        """Gives everything back; harmless when repeated or when the device is gone."""
        handle, self._handle = self._handle, None
        if handle is None:
            return
        try:
            if self._claimed is not None:
                self._backend.release_interface(handle, self._claimed)
        except (usb.core.USBError, NotImplementedError):
            pass  # it is gone, and its interfaces with it
        finally:
            self._claimed = None
            self._backend.close_device(handle)

    def _translated(self, error: Exception) -> CameraError:
        number = error.errno if isinstance(error, usb.core.USBError) else errno.ENOSYS
        name = str(self.device)
        if number == errno.EPIPE:
            return StalledError(f"The {name} refuses a request.")
        if number == errno.ENODEV:
            return CameraGoneError(f"The {name} is not there any more; plug it in again.")
        if number == errno.EACCES:
            return CameraError(_NO_ACCESS.get(self._platform, _NO_ACCESS["linux"]).format(name=name))
        if number == errno.EBUSY:
            return CameraError(_BUSY.get(self._platform, _BUSY["linux"]).format(name=name))
        if number == errno.ETIMEDOUT:
            return CameraError(
                f"The {name} did not answer within {_TIMEOUT_MS} ms; unplug it and plug it in again."
            )
        if number in (errno.ENOSYS, errno.ENOENT):
            return CameraError(_NO_DRIVER.get(self._platform, _NO_DRIVER["linux"]).format(name=name))
        return CameraError(f"USB failed with the {name}: {error}; check its cable and plug it in again.")


_NO_ACCESS = {
    "linux": "No permission for the {name}; install the udev rule that `relight doctor` prints, then plug "
    "the camera in again.",
    "darwin": "macOS does not let a program have the {name}; use opencv: and set its controls in the "
    "maker's program.",
    "win32": "Windows does not let a program have the {name}: another one uses it, or its driver is not "
    "libusb's; close other programs, or use opencv:.",
}
_BUSY = {
    "linux": "The {name} is held by the kernel's camera driver (uvcvideo), which has its controls; open it "
    "as v4l2:/dev/videoN.",
    "darwin": "The {name} is in use by another program; close it, or use opencv:.",
    "win32": "The {name} is in use by another program; close it, or use opencv:.",
}
_NO_DRIVER = {
    "linux": "libusb cannot use the {name} on this system; open it as v4l2:/dev/videoN or opencv:N.",
    "darwin": "libusb cannot use the {name} on this system; use opencv:.",
    "win32": "The {name} has Windows' own driver, through which libusb cannot speak to it; use opencv:, or "
    "give its control interface the libusbK driver with Zadig, after which other programs cannot use it.",
}
