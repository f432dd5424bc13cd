"""Cameras with poses, and `cameras.json`: the posed image set that sources, simulators and tools exchange.

Axes: x right, y down, z forward; the centre of the top-left pixel is (0.5, 0.5); lengths in metres. A world
point projects as

    x_cam = cam_from_world @ x_world,    u = fx x/z + cx,    v = fy y/z + cy

A cameras.json object:

    name, units ("metres" or "arbitrary"), transfer (e.g. "srgb")
    width, height, K [3][3], distortion [n]       shared, or given in a frame
    flash: {offset_cam [3]}                       flash position in camera axes (optional)
    splits: {flash: [index], val: [index]}        used where a frame itself does not say (optional)
    frames: [{index, file, mask, linear, flash 1|0|null, split "train"|"val", pts_s, flash_position [3],
              R [3][3] and t [3], or cam_from_world [4][4] or [3][4]}]

Only the pose of a frame is required where the shared fields are there. Unknown keys are ignored: measured
truth (light colours, albedo) lives beside the inputs in such files and is no business of a reader of cameras.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.errors import SourceError, TransferError
from capture.json_fields import Fields, read_json
from capture.transfer import canonical_transfer

LARGEST_SIDE = 1 << 16  # pixels
_LARGEST_INDEX = 10**9
_ROTATION_TOLERANCE = 1e-4  # poses are commonly written with 6 to 9 digits
_FLASH_TOLERANCE_M = (
    1e-3  # spread of the flash position in camera axes that still counts as "fixed to the camera"
)
_DISTORTION_LENGTHS = (1, 2, 4, 5, 8)  # OpenCV's without thin prism and tilt, and k1 or k1, k2 alone


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with lens distortion and a pose.

    Attributes:
        name: stem of its image file, e.g. "0010".
        width: pixels.
        height: pixels.
        K: [3, 3] intrinsics in pixels, no skew.
        cam_from_world: [4, 4] rigid, world units to camera axes.
        distortion: [n] in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6; empty or zeros = none.
        flash: 1 or 0 as the frame says, None = unknown.
    """

    name: str
    width: int
    height: int
    K: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    flash: int | None = None

    @property
    def centre_world(self) -> NDArray[np.float64]:
        """[3] position of the camera in the world."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        centre: NDArray[np.float64] = -rotation.T @ translation
        return centre

    @property
    def opencv_distortion(self) -> NDArray[np.float64]:
        """`distortion` in a length that OpenCV takes: it refuses one or two coefficients."""
        padded = np.zeros(max(4, len(self.distortion)))
        padded[: len(self.distortion)] = self.distortion
        return padded

    def scaled(self, factor: float) -> Camera:
        """The camera of the picture resized by a factor, its sides rounded to whole pixels.

        The corner (0, 0) of the picture stays the corner; K follows the ratio of the rounded sides.
        """
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=scale @ self.K)


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One entry of a cameras.json.

    Attributes:
        camera: intrinsics and pose.
        index: the frame's number, unique in its set.
        file: the picture; None = a camera without one.
        mask: coverage of the subject, 0..255.
        linear: the same picture in linear radiance (truth, for measuring).
        flash: 1, 0 or None = partial or unknown.
        split: "train", "val" or None.
        pts_s: time in the video it belongs to, seconds.
    """

    camera: Camera
    index: int
    file: Path | None = None
    mask: Path | None = None
    linear: Path | None = None
    flash: int | None = None
    split: str | None = None
    pts_s: float | None = None


@dataclass(frozen=True, eq=False)
class PosedSet:
    """Cameras of one scene, and where their pictures are.

    Attributes:
        name: what the set is called.
        frames: in file order, never empty.
        transfer: canonical name of the pictures' transfer function.
        flash_offset_cam_m: [3] flash position in camera axes, None = not given.
        root: folder that the file names are relative to.
        units: "metres" or "arbitrary".
    """

    name: str
    frames: tuple[PosedFrame, ...]
    transfer: str
    flash_offset_cam_m: NDArray[np.float64] | None
    root: Path
    units: str = "metres"


def load_posed_set(path: Path) -> PosedSet:
    """Reads a cameras.json (or the one in a folder). Whether the pictures exist is not looked at.

    Raises:
        SourceError: missing, malformed or impossible; the message names the frame.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "cameras.json"
    fields = read_json(path, SourceError)
    frames = []
    names: dict[str, int] = {}
    indices: set[int] = set()
    offsets = []
    splits = _splits(fields)
    for position, entry in enumerate(fields.children("frames", "frame")):
        frame = _frame(entry, fields, position, path.parent, splits)
        if frame.index in indices:
            raise entry.fail(f"the index {frame.index} is used twice.")
        if frame.camera.name in names:
            raise entry.fail(
                f"the name {frame.camera.name!r} is already that of frame {names[frame.camera.name]}; "
                "name the files apart."
            )
        indices.add(frame.index)
        names[frame.camera.name] = position
        frames.append(frame)
        flash_world = entry.array("flash_position", (3,), None)
        if flash_world is not None:
            pose = frame.camera.cam_from_world
            offsets.append(pose[:3, :3] @ flash_world + pose[:3, 3])
    if not frames:
        raise fields.fail('"frames" is empty: there is no camera to use.')
    return PosedSet(
        name=fields.text("name", path.parent.name),
        frames=tuple(frames),
        transfer=_transfer(fields),
        flash_offset_cam_m=_flash_offset(fields, offsets),
        root=path.parent,
        units=_units(fields),
    )


def save_posed_set(posed_set: PosedSet, path: Path) -> None:
    """Writes a set as cameras.json; file names become relative to its folder where they lie below it.

    Numbers are written with all their digits: reading gives the same set.
    """
    path = Path(path)
    content: dict[str, Any] = {
        "name": posed_set.name,
        "units": posed_set.units,
        "camera_convention": "OpenCV: x_cam = R x_world + t; x right, y down, z forward; centres at 0.5",
        "transfer": posed_set.transfer,
    }
    if posed_set.flash_offset_cam_m is not None:
        content["flash"] = {"offset_cam": posed_set.flash_offset_cam_m.tolist()}
    content["frames"] = [_frame_json(frame, path.parent) for frame in posed_set.frames]
    atomic_write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def check_rotation(rotation: NDArray[np.float64]) -> str | None:
    """What is wrong with a [3, 3] rotation matrix, None = nothing."""
    bounded = np.clip(rotation, -2.0, 2.0)  # no entry of a rotation exceeds 1; huge ones would overflow
    deviation = float(np.abs(bounded @ bounded.T - np.eye(3)).max())
    if not deviation <= _ROTATION_TOLERANCE:
        return f"the rotation is not orthonormal (off by {deviation:.2g}, limit {_ROTATION_TOLERANCE:g})"
    if np.linalg.det(rotation) < 0:
        return "the rotation is a reflection (its determinant is -1); check the axes"
    return None


def check_intrinsics(K: NDArray[np.float64]) -> str | None:
    """What is wrong with a [3, 3] intrinsic matrix, None = nothing."""
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        return f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px; they must be positive"
    if abs(K[0, 1]) > 1e-9 * K[0, 0] or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        return "K must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew)"
    return None


def nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] rotation closest to a nearly orthonormal matrix (Frobenius norm): takes out the rounding."""
    left, _, right = np.linalg.svd(matrix)
    rotation: NDArray[np.float64] = left @ right
    return rotation


def _frame(
    entry: Fields, shared: Fields, position: int, root: Path, splits: dict[str, frozenset[float]]
) -> PosedFrame:
    index = entry.integer("index", position, 0, _LARGEST_INDEX)
    file, mask, linear = (_path(entry, key, root) for key in ("file", "mask", "linear"))
    flash = entry.integer("flash", None, 0, 1)
    if "flash" not in entry.values and "flash" in splits:
        flash = int(index in splits["flash"])
    split = entry.text("split", None)
    if split is None and "val" in splits:
        split = "val" if index in splits["val"] else "train"
    if split not in (None, "train", "val"):
        split = None  # other sets ("test", "gt") are neither fitted nor validated on
    name = entry.text("name", None) or (file.stem if file else f"{index:04d}")
    if "/" in name or "\\" in name or name in (".", ".."):
        raise entry.fail(f"the name {name!r} cannot be that of a file.")  # renderings are named by it
    camera = Camera(
        name=name,
        width=_own_or_shared(entry, shared, "width").integer("width", low=1, high=LARGEST_SIDE),
        height=_own_or_shared(entry, shared, "height").integer("height", low=1, high=LARGEST_SIDE),
        K=_intrinsics(_own_or_shared(entry, shared, "K")),
        cam_from_world=_pose(entry),
        distortion=_distortion(_own_or_shared(entry, shared, "distortion")),
        flash=flash,
    )
    pts_s = entry.number("pts_s", None)
    return PosedFrame(camera, index, file, mask, linear, flash, split, pts_s)


def _own_or_shared(entry: Fields, shared: Fields, key: str) -> Fields:
    return entry if key in entry or key not in shared else shared


def _intrinsics(fields: Fields) -> NDArray[np.float64]:
    K: NDArray[np.float64] = fields.array("K", (3, 3))
    if complaint := check_intrinsics(K):
        raise fields.fail(f"{complaint}.")
    return K


def _distortion(fields: Fields) -> NDArray[np.float64]:
    distortion: NDArray[np.float64] = fields.array("distortion", (None,), np.zeros(0))
    if not distortion.any():
        return np.zeros(0)
    if len(distortion) not in _DISTORTION_LENGTHS:
        raise fields.fail(
            f'"distortion" has {len(distortion)} values; 4, 5 or 8 in the order of OpenCV are read.'
        )
    return distortion


def _pose(entry: Fields) -> NDArray[np.float64]:
    if "cam_from_world" in entry:
        cam_from_world = entry.affine("cam_from_world")
    else:
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = entry.array("R", (3, 3))
        cam_from_world[:3, 3] = entry.array("t", (3,))
    if complaint := check_rotation(cam_from_world[:3, :3]):
        raise entry.fail(f"{complaint}.")
    cam_from_world[:3, :3] = nearest_rotation(cam_from_world[:3, :3])
    return cam_from_world


def _path(entry: Fields, key: str, root: Path) -> Path | None:
    name = entry.text(key, None)
    return root / name if name else None


def _splits(fields: Fields) -> dict[str, frozenset[float]]:
    splits = fields.child("splits", None)
    if splits is None:
        return {}
    named = {key: splits.array(key, (None,), None) for key in ("flash", "val")}
    return {key: frozenset(values.tolist()) for key, values in named.items() if values is not None}


def _transfer(fields: Fields) -> str:
    try:
        return canonical_transfer(fields.text("transfer", "srgb"))
    except TransferError as cause:
        raise fields.fail(str(cause)) from cause


def _units(fields: Fields) -> str:
    text = fields.text("units", "metres")
    if text.lower() in ("metres", "meters", "metre", "meter", "m"):
        return "metres"
    if text.lower() in ("arbitrary", "unknown"):
        return "arbitrary"
    raise fields.fail(f'"units" is {text!r}; convert the poses and points to metres, or say "arbitrary".')


def _flash_offset(fields: Fields, offsets: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """The flash in camera axes: as stated, else from the frames' positions where these agree on one."""
    flash = fields.child("flash", None)
    stated: NDArray[np.float64] | None = flash.array("offset_cam", (3,), None) if flash else None
    if not offsets:
        return stated
    offset = np.median(offsets, axis=0) if stated is None else stated
    if float(np.abs(np.array(offsets) - offset).max()) <= _FLASH_TOLERANCE_M:
        return offset
    if stated is None:
        return None  # a flash that does not move with the camera has no offset in camera axes
    raise fields.fail(
        '"flash_position" of the frames contradicts flash.offset_cam by more than 1 mm; remove the wrong one.'
    )


def _frame_json(frame: PosedFrame, root: Path) -> dict[str, Any]:
    camera = frame.camera
    entry: dict[str, Any] = {"index": frame.index, "name": camera.name}
    for key, file in (("file", frame.file), ("mask", frame.mask), ("linear", frame.linear)):
        if file is not None:
            entry[key] = (file.relative_to(root) if file.is_relative_to(root) else file).as_posix()
    entry["flash"] = frame.flash
    if frame.split is not None:
        entry["split"] = frame.split
    if frame.pts_s is not None:
        entry["pts_s"] = frame.pts_s
    entry |= {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
    if camera.distortion.any():
        entry["distortion"] = camera.distortion.tolist()
    entry["cam_from_world"] = camera.cam_from_world.tolist()
    return entry
