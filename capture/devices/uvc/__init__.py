"""UVC cameras by USB control requests, where there is no V4L2: `uvc:VID:PID;serial=X;stream=opencv:0`.

Exposure, gain, white balance, focus and the automatics are set and read back by the requests of the USB
Video Class through libusb; the pictures come from another back end, by default `opencv:0`. Whether both are
the same camera is shown by the light: a halved exposure must halve it.

    Linux    The kernel's driver (uvcvideo) has the camera and its controls: use `v4l2:/dev/videoN`. Without
             that driver the controls can be set here, but no picture comes unless `stream=` names another
             source.
    macOS    The system keeps the camera's interfaces; requests on endpoint 0 pass on some versions and are
             refused on others. Where they are refused, `opencv:` is what is left, and OpenCV sets no
             exposure there: set it in the maker's program.
    Windows  libusb reaches a camera only when its control interface has a libusb driver (libusbK, by Zadig),
             which takes the camera away from every other program, OpenCV too: the pictures must then come
             from somewhere else. `opencv:` without `uvc:` is the usual way.

The two last are built on what the documentation says and were not tried on such machines.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path

from capture.devices.bench import Bench
from capture.devices.camera import CameraDevice, CameraInfo
from capture.devices.url_options import parse_options
from capture.devices.uvc.camera import UvcCamera
from capture.devices.uvc.control_lock import ControlLock
from capture.devices.uvc.descriptors import VideoControl, parse_video_control
from capture.devices.uvc.requests import UvcControls
from capture.devices.uvc.usb_link import UsbBackend, UsbCamera, UsbLink, find_cameras, libusb
from capture.errors import CameraError

_TARGET = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")
_DEFAULT_STREAM = "opencv:0"


def open_camera(rest: str, bench: Bench) -> CameraDevice:
    """The camera of `VID:PID;serial=...;stream=URL`; nothing before the settings = the only one there is.

    Raises:
        CameraError: libusb is missing, no such camera or several, no permission, in use, or no stream.
    """
    return open_uvc(rest, bench, libusb())


def open_uvc(rest: str, bench: Bench, backend: UsbBackend, platform: str = sys.platform) -> UvcCamera:
    """As `open_camera`, through a libusb of the caller's."""
    url = f"uvc:{rest}"
    target, _, text = rest.partition(";")
    settings = parse_options(text, {"serial": str, "stream": str}, CameraError, scheme="uvc")
    match = _TARGET.fullmatch(target)
    if target and match is None:
        raise CameraError(f"{url} is not understood; it is uvc:VID:PID in hexadecimal, as uvc:046d:082d.")
    wanted = (int(match[1], 16), int(match[2], 16)) if match else None
    stream_url = settings.get("stream", "" if platform.startswith("linux") else _DEFAULT_STREAM)
    link, interface = _open_link(url, backend, wanted, settings.get("serial"), platform)
    try:
        link.claim(interface.interface)
        if not stream_url:
            raise CameraError(
                f"The {link.device} gives no pictures by this way on Linux; load its driver (modprobe "
                "uvcvideo) and use v4l2:/dev/videoN, or name their source (stream=opencv:N)."
            )
        controls = UvcControls(link, interface)
        stream = _open_stream(stream_url, bench)
    except BaseException:
        link.close()
        raise
    return UvcCamera(
        _info(url, link, interface, controls, stream), link, ControlLock(controls, bench), stream
    )


def list_cameras() -> tuple[str, ...]:
    """URLs of the cameras that libusb sees, none where V4L2 has them."""
    if Path("/sys/class/video4linux").is_dir():
        return ()
    try:
        return list_uvc(libusb())
    except CameraError:
        return ()


def list_uvc(backend: UsbBackend) -> tuple[str, ...]:
    """As `list_cameras`; two of a kind are told apart by their serial numbers."""
    cameras = find_cameras(backend)
    kinds = Counter((camera.vendor, camera.product) for camera in cameras)
    urls = []
    for camera in cameras:
        url = f"uvc:{camera.vendor:04x}:{camera.product:04x}"
        if kinds[camera.vendor, camera.product] > 1 and (serial := _serial_of(backend, camera)):
            url += f";serial={serial}"
        urls.append(url)
    return tuple(urls)


def _serial_of(backend: UsbBackend, camera: UsbCamera) -> str:
    try:
        link = UsbLink(backend, camera)
    except CameraError:
        return ""
    try:
        return link.text(camera.serial_string)
    finally:
        link.close()


def _open_link(
    url: str, backend: UsbBackend, wanted: tuple[int, int] | None, serial: str | None, platform: str
) -> tuple[UsbLink, VideoControl]:
    cameras = find_cameras(backend)
    fitting = [camera for camera in cameras if wanted in (None, (camera.vendor, camera.product))]
    if serial is not None:
        fitting = [camera for camera in fitting if _serial_of(backend, camera) == serial]
    if not fitting:
        there = ", ".join(list_uvc(backend)) or "none"
        raise CameraError(f"No camera fits {url}; plugged in: {there}.")
    if len(fitting) > 1:
        raise CameraError(f"{len(fitting)} cameras fit {url}; name one of {', '.join(list_uvc(backend))}.")
    (camera,) = fitting
    return UsbLink(backend, camera, platform), parse_video_control(camera.interface, camera.specific)


def _open_stream(url: str, bench: Bench) -> CameraDevice:
    from capture.devices.table import open_camera as open_by_url

    scheme = url.partition(":")[0]
    if scheme == "uvc":
        raise CameraError(f"stream={url} is no source of pictures; give stream=opencv:N.")
    # OpenCV would set the same controls by its own ways, and worse.
    return open_by_url(f"{url};controls=leave" if scheme == "opencv" else url, bench)


def _info(
    url: str, link: UsbLink, interface: VideoControl, controls: UvcControls, stream: CameraDevice
) -> CameraInfo:
    device = link.device
    return CameraInfo(
        url=url,
        name=link.text(device.product_string) or str(device),
        back_end="uvc",
        details={
            "usb": f"{device.vendor:04x}:{device.product:04x}",
            "serial": link.text(device.serial_string),
            "uvc_version": interface.uvc_version,
            "controls": list(controls.names),
            "announced_but_refused": list(controls.refused),
            "stream": stream.info.url,
            "stream_details": dict(stream.info.details),
        },
        clock=stream.info.clock,
        stamp_at=stream.info.stamp_at,
    )
