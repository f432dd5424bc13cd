"""What a camera's VideoControl interface says of itself: its units, and which controls they announce.

Layout: UVC 1.5, section 3.7.2 (class-specific VideoControl descriptors), which older revisions share but for
the length of a processing unit's `bmControls`. Numbers are little-endian.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from uuid import UUID

from capture.errors import CameraError

_CLASS_SPECIFIC = 0x24
_HEADER, _INPUT_TERMINAL, _PROCESSING_UNIT, _EXTENSION_UNIT = 0x01, 0x02, 0x05, 0x06
_CAMERA_TERMINAL_TYPE = 0x0201


class Entity(Enum):
    """Where a control lives."""

    CAMERA_TERMINAL = "camera terminal"
    PROCESSING_UNIT = "processing unit"


@dataclass(frozen=True, kw_only=True)
class Unit:
    """A terminal or unit of the camera.

    Attributes:
        number: `bTerminalID` or `bUnitID`, which requests are addressed to.
        controls: `bmControls`: bit D of the specification's table is 1 << D here.
    """

    number: int
    controls: int


@dataclass(frozen=True, kw_only=True)
class VideoControl:
    """A VideoControl interface.

    Attributes:
        interface: Its number.
        uvc_version: As text: "1.00", "1.10", "1.50".
        units: The first camera terminal and the first processing unit, where there are such.
        extensions: Number and GUID of each extension unit, the maker's own, which are left alone.
    """

    interface: int
    uvc_version: str
    units: dict[Entity, Unit]
    extensions: tuple[tuple[int, str], ...] = ()


def parse_video_control(interface: int, specific: bytes) -> VideoControl:
    """A VideoControl interface from the class-specific descriptors that follow its own.

    Args:
        interface: Its number.
        specific: Those descriptors' bytes, one after the other.

    Raises:
        CameraError: They are cut short or malformed.
    """
    version = "unknown"
    units: dict[Entity, Unit] = {}
    extensions: list[tuple[int, str]] = []
    for descriptor in _split(specific):
        kind = descriptor[2] if descriptor[1] == _CLASS_SPECIFIC and len(descriptor) > 3 else None
        if kind == _HEADER and len(descriptor) >= 5:
            version = f"{descriptor[4]:x}.{descriptor[3]:02x}"
        elif kind == _INPUT_TERMINAL and int.from_bytes(descriptor[4:6], "little") == _CAMERA_TERMINAL_TYPE:
            units.setdefault(Entity.CAMERA_TERMINAL, _unit(descriptor, size_at=14))
        elif kind == _PROCESSING_UNIT:
            units.setdefault(Entity.PROCESSING_UNIT, _unit(descriptor, size_at=7))
        elif kind == _EXTENSION_UNIT and len(descriptor) >= 20:
            extensions.append((descriptor[3], str(UUID(bytes_le=descriptor[4:20]))))
    return VideoControl(interface=interface, uvc_version=version, units=units, extensions=tuple(extensions))


def _split(data: bytes) -> Iterator[bytes]:
    """Descriptor after descriptor: each begins with its length and its type."""
    at = 0
    while at < len(data):
        length = data[at]
        if length < 2 or at + length > len(data):
            raise CameraError(
                f"The camera's USB descriptors are malformed at byte {at} of {len(data)}; unplug it "
                "and plug it in again, or update its firmware."
            )
        yield data[at : at + length]
        at += length


def _unit(descriptor: bytes, size_at: int) -> Unit:
    """A unit whose `bControlSize` is at that place, and `bmControls` after it; what is cut off is 0."""
    size = descriptor[size_at] if len(descriptor) > size_at else 0
    controls = descriptor[size_at + 1 : size_at + 1 + size]
    return Unit(number=descriptor[3], controls=int.from_bytes(controls, "little"))
