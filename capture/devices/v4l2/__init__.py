"""V4L2 cameras: `v4l2:/dev/video0`, or the path alone.

structs.py   layouts and numbers of linux/videodev2.h
kernel.py    open, ioctl, mmap, poll: what a double stands in for
node.py      a device node, its modes, and its errors in words
controls.py  controls by id
stream.py    frames out of mapped buffers
stamps.py    times of frames, with impossible ones put right
choice.py    which mode a capture takes
settings.py  which controls a lock touches
locking.py   the order that works, read-back, light
camera.py    all of it behind `CameraDevice`
fake*.py     a driver in software with the faults of real ones
"""

from __future__ import annotations

import re
from pathlib import Path

from capture.devices.bench import Bench
from capture.devices.camera import CameraDevice
from capture.devices.v4l2.camera import V4l2Camera
from capture.devices.v4l2.kernel import Kernel, LinuxKernel
from capture.devices.v4l2.node import VideoNode
from capture.errors import CameraError


def open_camera(rest: str, bench: Bench) -> CameraDevice:
    """The camera of a node: its path, a link to it (/dev/v4l/by-id/...), or its number.

    Raises:
        CameraError: See `capture.devices.v4l2.node`.
    """
    path = f"/dev/video{rest}" if rest.isdecimal() else rest
    if not path.startswith("/"):
        raise CameraError(f"v4l2:{rest} names no camera; use a path as v4l2:/dev/video0.")
    return V4l2Camera(LinuxKernel(), path, path, "v4l2", bench.clock)


def list_cameras() -> tuple[str, ...]:
    """Paths of the nodes that capture video, in order; metadata nodes and what cannot be opened left out."""
    return tuple(path for path in _nodes() if _captures(LinuxKernel(), path))


def _nodes() -> list[str]:
    paths = [path for path in Path("/dev").glob("video*") if re.fullmatch(r"video\d+", path.name)]
    return [str(path) for path in sorted(paths, key=lambda path: int(path.name[5:]))]


def _captures(kernel: Kernel, path: str) -> bool:
    try:
        node = VideoNode(kernel, path)
    except CameraError:
        return False
    try:
        return bool(node.modes())
    except CameraError:
        return False
    finally:
        node.close()
