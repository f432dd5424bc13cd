"""A video node: opened, asked, told; what goes wrong comes out as an error for the user."""

from __future__ import annotations

import contextlib
import ctypes
import errno
from collections.abc import Iterator
from dataclasses import dataclass

from capture.devices.v4l2 import structs as v4l2
from capture.devices.v4l2.kernel import Kernel, retry
from capture.errors import CameraError, CameraGoneError

_GONE = (errno.ENODEV, errno.ENXIO)
#: What a USB camera's driver says when the cable or the firmware fails: hints differ, advice is the same.
_LINK = (errno.EIO, errno.EPROTO, errno.EPIPE, errno.ETIMEDOUT, errno.EILSEQ, errno.EOVERFLOW, errno.ECOMM)


@dataclass(frozen=True)
class Mode:
    """A picture size of a format.

    Attributes:
        pixel_format: Four characters.
        width: Pixels.
        height: Pixels.
        rates: Frame rates, highest first; empty = the driver does not say.
        stepwise: Largest of a range of sizes, all of which it can do in steps.
    """

    pixel_format: str
    width: int
    height: int
    rates: tuple[float, ...]
    stepwise: bool = False


class VideoNode:
    """An open device node. Every method may raise `CameraError`, `CameraGoneError` when it is not there."""

    def __init__(self, kernel: Kernel, path: str) -> None:
        """Opens it and looks whether it captures video."""
        self.path = path
        self._kernel = kernel
        self._descriptor = -1
        self._open()
        try:
            self.capability = v4l2.Capability()
            self.ask(v4l2.QUERYCAP, self.capability, "be asked what it is")
            self._require_capture()
        except CameraError:
            self.close()
            raise

    def close(self) -> None:
        """Closes it; harmless when repeated."""
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            with contextlib.suppress(OSError):  # it is released whatever close(2) says
                self._kernel.close(descriptor)

    def reopen(self) -> None:
        """Lets go of everything that the driver keeps for this opening, then opens it again."""
        self.close()
        self._open()

    def call(self, request: int, argument: ctypes._CData) -> None:
        """An ioctl that raises `OSError` as it is; the caller knows what its number means."""
        if self._descriptor < 0:
            raise CameraError(f"{self.path} is closed.")
        retry(lambda: self._kernel.ioctl(self._descriptor, request, argument))

    def ask(self, request: int, argument: ctypes._CData, doing: str) -> None:
        """An ioctl whose failure is an error: "/dev/video0 cannot `doing`: ..."."""
        try:
            self.call(request, argument)
        except OSError as error:
            raise translated(error, self.path, doing) from error

    def map(self, length: int, offset: int) -> object:
        """Shares a buffer with the driver."""
        return self._kernel.mmap(self._descriptor, length, offset)

    def wait(self, timeout_s: float) -> bool:
        """Waits for a buffer; True also when asking for one will tell what is wrong."""
        try:
            return self._kernel.wait(self._descriptor, timeout_s)
        except OSError as error:
            raise translated(error, self.path, "be waited for") from error

    def modes(self) -> tuple[Mode, ...]:
        """Everything that the driver lists, in its order."""
        return tuple(
            mode for pixel_format in self._formats() for mode in self._sizes(v4l2.fourcc_name(pixel_format))
        )

    def format(self) -> v4l2.PixelFormat:
        """The format that is set."""
        about = v4l2.Format(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        self.ask(v4l2.G_FMT, about, "be asked for its format")
        return about.fmt.pix

    def set_format(self, pixel_format: str, width: int, height: int) -> v4l2.PixelFormat:
        """Sets a format; the driver may settle for another, which is what comes back."""
        about = v4l2.Format(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        self.ask(v4l2.G_FMT, about, "be asked for its format")
        pix = about.fmt.pix
        pix.width, pix.height, pix.pixelformat = width, height, v4l2.fourcc(pixel_format)
        pix.field, pix.bytesperline, pix.sizeimage = v4l2.FIELD_ANY, 0, 0
        # Let the driver say the colours of the new format, not keep those of the old one.
        pix.colorspace = pix.ycbcr_enc = pix.quantization = pix.xfer_func = pix.flags = 0
        self.ask(v4l2.S_FMT, about, f"be set to {width} x {height} {pixel_format}")
        return about.fmt.pix

    def rate(self) -> float | None:
        """Frames a second that the driver promises; None = it does not say."""
        about = v4l2.StreamParameters(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        try:
            self.call(v4l2.G_PARM, about)
        except OSError as error:
            self._unless_absent(error, "be asked for its frame rate")
            return None
        return _rate(about.parm.capture.timeperframe)

    def set_rate(self, fps: float) -> float | None:
        """Asks for a frame rate; what the driver makes of it, None = it has no rate to set."""
        about = v4l2.StreamParameters(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        about.parm.capture.timeperframe = v4l2.Fraction(1000, max(1, round(fps * 1000)))
        try:
            self.call(v4l2.S_PARM, about)
        except OSError as error:
            self._unless_absent(error, f"be set to {fps:g} frames a second")
            return None
        return _rate(about.parm.capture.timeperframe)

    def describe(self) -> dict[str, str]:
        """Driver, name, bus, and what the system knows of the device."""
        capability = self.capability
        version = capability.version
        return {
            "path": self.path,
            "driver": _text(capability.driver),
            "card": _text(capability.card),
            "bus": _text(capability.bus_info),
            "driver_version": f"{version >> 16}.{version >> 8 & 255}.{version & 255}",
            **self._kernel.describe(self.path),
        }

    def _open(self) -> None:
        try:
            self._descriptor = self._kernel.open(self.path)
        except OSError as error:
            raise translated(error, self.path, "be opened") from error

    def _require_capture(self) -> None:
        capability = self.capability
        own = capability.capabilities & v4l2.CAP_DEVICE_CAPS
        caps = capability.device_caps if own else capability.capabilities
        if caps & v4l2.CAP_VIDEO_CAPTURE_MPLANE:
            raise CameraError(
                f"{self.path} ({_text(capability.card)}) delivers pictures in several planes, which is not "
                "supported; use the camera's other node, or its pictures through another back end (opencv:)."
            )
        if not caps & v4l2.CAP_VIDEO_CAPTURE:
            raise CameraError(
                f"{self.path} ({_text(capability.card)}) captures no video; a camera often has a second node "
                "for metadata: use the one with the lower number."
            )
        if not caps & v4l2.CAP_STREAMING:
            raise CameraError(f"{self.path} ({_text(capability.card)}) cannot stream into mapped buffers.")

    def _formats(self) -> Iterator[int]:
        for index in range(256):
            about = v4l2.FormatDescription(index=index, type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
            if not self._listed(v4l2.ENUM_FMT, about):
                return
            yield about.pixelformat

    def _sizes(self, pixel_format: str) -> Iterator[Mode]:
        for index in range(1024):
            about = v4l2.FrameSize(index=index, pixel_format=v4l2.fourcc(pixel_format))
            if not self._listed(v4l2.ENUM_FRAMESIZES, about):
                return
            if about.type == v4l2.FRMSIZE_DISCRETE:
                width, height = about.size.min_width, about.size.max_width
                yield Mode(pixel_format, width, height, self._rates(pixel_format, width, height))
                continue
            width, height = about.size.max_width, about.size.max_height
            yield Mode(pixel_format, width, height, self._rates(pixel_format, width, height), stepwise=True)
            return

    def _rates(self, pixel_format: str, width: int, height: int) -> tuple[float, ...]:
        rates: set[float] = set()
        for index in range(256):
            about = v4l2.FrameInterval(
                index=index, pixel_format=v4l2.fourcc(pixel_format), width=width, height=height
            )
            if not self._listed(v4l2.ENUM_FRAMEINTERVALS, about):
                break
            shortest = _rate(about.interval.min)
            rates |= set() if shortest is None else {shortest}
            if about.type != v4l2.FRMIVAL_DISCRETE:
                break
        return tuple(sorted(rates, reverse=True))

    def _listed(self, request: int, argument: ctypes._CData) -> bool:
        """Whether an enumeration has an entry of this index: EINVAL ends it, ENOTTY = the driver has none."""
        try:
            self.call(request, argument)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return False
            raise translated(error, self.path, "list its formats") from error
        return True

    def _unless_absent(self, error: OSError, doing: str) -> None:
        """Raises, unless the driver only says that it has no such call."""
        if error.errno not in (errno.EINVAL, errno.ENOTTY):
            raise translated(error, self.path, doing) from error


def translated(error: OSError, path: str, doing: str) -> CameraError:
    """A driver's error number as a sentence that says what to do."""
    if error.errno == errno.ENOENT:
        return CameraGoneError(
            f"{path} does not exist; plug the camera in, or see what `ls /dev/video*` says."
        )
    if error.errno in _GONE:
        return CameraGoneError(f"{path} is not there any more; plug the camera in again and use --resume.")
    if error.errno == errno.EBUSY:
        return CameraError(
            f"{path} cannot {doing}: it is in use; close the program that has it (`fuser {path}` names it)."
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return CameraError(
            f"{path} cannot {doing}: permission denied; add yourself to the group video, or install the udev "
            "rule that `relight doctor` prints, and log in again."
        )
    if error.errno == errno.ENOSPC:
        return CameraError(
            f"{path} cannot {doing}: no bandwidth is left on its USB bus; use a smaller picture, a lower "
            "rate or MJPG, or put the camera on a port of its own."
        )
    name = errno.errorcode.get(error.errno or 0, str(error.errno))
    if error.errno in _LINK:
        return CameraError(
            f"{path} cannot {doing}: the link to the camera has failed ({name}); plug it in again, without a "
            "hub or with a shorter cable."
        )
    return CameraError(f"{path} cannot {doing}: {error.strerror or 'the driver refuses'} ({name}).")


def _rate(interval: v4l2.Fraction) -> float | None:
    if interval.numerator == 0 or interval.denominator == 0:
        return None
    return float(interval.denominator) / float(interval.numerator)


def _text(name: bytes) -> str:
    return name.decode("utf-8", errors="replace").strip()
