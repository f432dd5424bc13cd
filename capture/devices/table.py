"""Cameras and flashes by URL: a lazy table of back ends, of which the simulated ones are ordinary entries.

A URL is a scheme, a colon, and what the back end makes of the rest: `sim:`, `litra:`, `replay:film.mp4`. A
device's path is one too: `/dev/video0` is `v4l2:/dev/video0`, `/dev/ttyUSB0` is `serial:/dev/ttyUSB0`. A back
end's module has `open_camera(rest, bench)` or `open_flash(rest, bench)`, and `list_cameras()` or
`list_flashes()`, which give the URLs of what is plugged in.
"""

from __future__ import annotations

import importlib
import logging
import re
from collections.abc import Mapping
from types import ModuleType

from capture.devices.bench import Bench, MonotonicClock, VirtualClock
from capture.devices.camera import CameraDevice
from capture.devices.flash import FlashDevice
from capture.errors import CameraError, DeviceError, FlashError

logger = logging.getLogger(__name__)

CAMERAS: Mapping[str, str] = {
    "v4l2": "capture.devices.v4l2",
    "uvc": "capture.devices.uvc",
    "opencv": "capture.devices.opencv",
    "replay": "capture.devices.replay",
    "fake-v4l2": "capture.devices.v4l2.fake",
    "sim": "capture.sim.device",
}
FLASHES: Mapping[str, str] = {
    "serial": "capture.devices.serial_flash",
    "hid-firmware": "capture.devices.hid.firmware",
    "litra": "capture.devices.hid.litra",
    "hidrelay": "capture.devices.hid.relay",
    "blink1": "capture.devices.hid.blink1",
    "manual": "capture.devices.manual",
    "sim": "capture.sim.device",
}
#: Back ends whose time passes only as their frames are asked for.
_VIRTUAL = frozenset({"sim", "fake-v4l2"})
_CAMERA_PATH = re.compile(r"/dev/(video|v4l/)")
_PORT_SCHEMES = ("hwgrep", "socket", "rfc2217", "spy", "alt", "loop")


def open_bench(camera_url: str, flash_url: str, duration_s: float = 16.0) -> Bench:
    """The desk of two devices: in simulated time when both are simulated.

    Args:
        camera_url: See `open_camera`.
        flash_url: See `open_flash`.
        duration_s: Of the recording: the hand of a simulated camera takes as long around the head.
    """
    schemes = {camera_scheme(camera_url)[0], flash_scheme(flash_url)[0]}
    return Bench(VirtualClock() if schemes <= _VIRTUAL else MonotonicClock(), walk_s=duration_s)


def open_camera(url: str, bench: Bench | None = None) -> CameraDevice:
    """The camera of a URL.

    Raises:
        CameraError: No such back end, no such device, no permission, or it is in use.
    """
    scheme, rest = camera_scheme(url)
    module = _module(CAMERAS, scheme, url, CameraError)
    camera: CameraDevice = module.open_camera(rest, bench or Bench())
    return camera


def open_flash(url: str, bench: Bench | None = None) -> FlashDevice:
    """The flash of a URL.

    Raises:
        FlashError: No such back end, no such device, no permission, or it is in use.
    """
    scheme, rest = flash_scheme(url)
    module = _module(FLASHES, scheme, url, FlashError)
    flash: FlashDevice = module.open_flash(rest, bench or Bench())
    return flash


def list_cameras() -> tuple[str, ...]:
    """URLs of the cameras that are plugged in; nothing is opened that opening would change."""
    return _listed(CAMERAS, "list_cameras")


def list_flashes() -> tuple[str, ...]:
    """URLs of the flashes that may be plugged in; a serial port is one until it has been asked."""
    return _listed(FLASHES, "list_flashes")


def camera_scheme(url: str) -> tuple[str, str]:
    """(scheme, rest) of a camera's URL; a number is /dev/videoN."""
    if url.isdecimal():
        return "v4l2", f"/dev/video{url}"
    if _CAMERA_PATH.match(url):
        return "v4l2", url
    return _split(url)


def flash_scheme(url: str) -> tuple[str, str]:
    """(scheme, rest) of a flash's URL; paths and pyserial's own URLs are serial ports."""
    if url.startswith("/") or url.upper().startswith("COM") or url.split(":")[0] in _PORT_SCHEMES:
        return "serial", url
    return _split(url)


def _listed(table: Mapping[str, str], function: str) -> tuple[str, ...]:
    """Of all back ends; one whose library or system is missing has none."""
    urls: list[str] = []
    for module_name in dict.fromkeys(table.values()):
        try:
            urls += getattr(importlib.import_module(module_name), function)()
        except DeviceError as error:
            logger.info("%s: %s", module_name, error)
    return tuple(urls)


def _split(url: str) -> tuple[str, str]:
    scheme, colon, rest = url.partition(":")
    return (scheme, rest) if colon else ("", url)


def _module(table: Mapping[str, str], scheme: str, url: str, error: type[DeviceError]) -> ModuleType:
    if scheme not in table:
        kind = "camera" if table is CAMERAS else "flash"
        known = ", ".join(f"{name}:" for name in table)
        raise error(f"{url} names no {kind}; use the path of a device or one of {known}.")
    return importlib.import_module(table[scheme])
