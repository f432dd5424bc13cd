"""COLMAP sparse models: cameras with poses and points; text and binary are read, text is written.

Formats: https://colmap.github.io/format.html (quaternions w, x, y, z; world to camera; pixel centres at 0.5).
Every count in a file is checked against the bytes that are left before anything is allocated.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.cameras import LARGEST_SIDE, Camera, check_intrinsics
from capture.errors import SourceError
from capture.json_fields import is_plain_text
from capture.ply import PointCloud

Key = TypeVar("Key")
Value = TypeVar("Value")

# Model names by their number in binary files (colmap/src/colmap/sensor/models.h).
_MODEL_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
)

# Of the models that we can express: number of focal lengths, and where the distortion goes in OpenCV's order.
_FOCALS_AND_DISTORTION: dict[str, tuple[int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (0,)),
    "RADIAL": (1, (0, 1)),
    "OPENCV": (2, (0, 1, 2, 3)),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7)),
}
_WRITTEN_MODELS = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse reconstruction.

    Attributes:
        cameras: image name (as in the model, with forward slashes) -> camera.
        points: the sparse points with colours; None = the model has none.
    """

    cameras: Mapping[str, Camera]
    points: PointCloud | None


@dataclass(frozen=True)
class _Intrinsics:
    width: int
    height: int
    K: NDArray[np.float64]
    distortion: NDArray[np.float64]


def is_colmap_model(folder: Path) -> bool:
    """Whether a folder holds the files of a model."""
    return any(
        (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt")
    )


def read_colmap_model(folder: Path) -> ColmapModel:
    """Reads a model; where binary and text files lie side by side the binary ones count, as in COLMAP.

    Raises:
        SourceError: missing, malformed, or with a camera that is not a pinhole with polynomial distortion.
    """
    folder = Path(folder)
    if not is_colmap_model(folder):
        raise SourceError(
            f"{folder} is no COLMAP model: it needs cameras.bin and images.bin, or the same as .txt."
        )
    if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file():
        intrinsics = dict(_unique(_binary_cameras(_Reader(folder / "cameras.bin")), folder / "cameras.bin"))
        cameras = dict(
            _unique(_binary_images(_Reader(folder / "images.bin"), intrinsics), folder / "images.bin")
        )
        points_file, read_points = folder / "points3D.bin", _binary_points
    else:
        intrinsics = dict(_unique(_text_cameras(folder / "cameras.txt"), folder / "cameras.txt"))
        cameras = dict(_unique(_text_images(folder / "images.txt", intrinsics), folder / "images.txt"))
        points_file, read_points = folder / "points3D.txt", _text_points
    if not cameras:
        raise SourceError(f"{folder} holds no image with a pose.")
    return ColmapModel(cameras, read_points(points_file) if points_file.is_file() else None)


def write_colmap_model(folder: Path, cameras: Mapping[str, Camera]) -> None:
    """Writes cameras as a text model without points; images with equal intrinsics share a camera.

    Numbers have all their digits: poses come back to within 1e-15.

    Args:
        folder: made when missing.
        cameras: image name -> camera.
    """
    ids: dict[str, int] = {}
    images = []
    for image_id, (name, camera) in enumerate(cameras.items(), start=1):
        if any(character in name for character in "\r\n\0"):
            raise ValueError(f"The image name {name!r} contains a line break.")
        camera_id = ids.setdefault(_camera_line(camera), len(ids) + 1)
        pose = [*quaternion_from_rotation(camera.cam_from_world[:3, :3]), *camera.cam_from_world[:3, 3]]
        images.append(f"{image_id} {_digits(pose)} {camera_id} {name}\n\n")
    folder.mkdir(parents=True, exist_ok=True)
    files = {
        "cameras.txt": (
            "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
            [f"{i} {text}\n" for text, i in ids.items()],
        ),
        "images.txt": (
            "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME / POINTS2D[] as (X, Y, ID)",
            images,
        ),
        "points3D.txt": ("POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)", []),
    }
    for name, (header, lines) in files.items():
        atomic_write(folder / name, f"# {header}\n{''.join(lines)}".encode())


def quaternion_from_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] unit quaternion w, x, y, z (w >= 0) of a [3, 3] rotation.

    The largest component is taken from the diagonal and the others from it (Shepperd 1978), which is accurate
    for every rotation.
    """
    r = rotation
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    # outer product 4 q q^T; its row with the largest diagonal entry gives q with the best conditioning
    outer = np.array(
        [
            [1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + 2 * r[0, 0] - trace, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 + 2 * r[1, 1] - trace, r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 + 2 * r[2, 2] - trace],
        ]
    )
    row = outer[int(np.argmax(np.diag(outer)))]
    quaternion: NDArray[np.float64] = row / np.linalg.norm(row)
    return quaternion if quaternion[0] >= 0 else -quaternion


def rotation_from_quaternion(quaternion: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] rotation of a quaternion w, x, y, z of any length but zero."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _camera_line(camera: Camera) -> str:
    """Model, size and parameters of a camera: what follows its number in cameras.txt."""
    if complaint := check_intrinsics(camera.K):
        raise ValueError(f"Camera {camera.name}: {complaint}.")
    distortion = np.trim_zeros(camera.distortion, "b")
    length = next((n for n in _WRITTEN_MODELS if n >= len(distortion)), None)
    if length is None:
        raise ValueError(
            f"Camera {camera.name}: COLMAP's models hold 8 distortion values, not {len(distortion)}."
        )
    K = camera.K
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion, *np.zeros(length - len(distortion))]
    return f"{_WRITTEN_MODELS[length]} {camera.width} {camera.height} {_digits(parameters)}"


def _digits(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _intrinsics(model: str, width: int, height: int, parameters: Sequence[float], place: str) -> _Intrinsics:
    focals, order = _model(model, place)
    if not 0 < width <= LARGEST_SIDE or not 0 < height <= LARGEST_SIDE:
        raise SourceError(f"{place}: the image size {width} x {height} is not in 1..{LARGEST_SIDE}.")
    if len(parameters) != focals + 2 + len(order):
        raise SourceError(
            f"{place}: {model} has {focals + 2 + len(order)} parameters, not {len(parameters)}."
        )
    if not all(map(math.isfinite, parameters)):
        raise SourceError(f"{place}: a parameter is not a finite number.")
    fx, fy = parameters[0], parameters[focals - 1]
    K = np.array([[fx, 0.0, parameters[focals]], [0.0, fy, parameters[focals + 1]], [0.0, 0.0, 1.0]])
    if complaint := check_intrinsics(K):
        raise SourceError(f"{place}: {complaint}.")
    distortion = np.zeros(max(4, len(order)))
    distortion[list(order)] = parameters[focals + 2 :]
    return _Intrinsics(width, height, K, distortion if distortion.any() else np.zeros(0))


def _model(name: str, place: str) -> tuple[int, tuple[int, ...]]:
    """(number of focal lengths, places of the distortion) of a camera model."""
    if name not in _FOCALS_AND_DISTORTION:
        raise SourceError(
            f"{place}: the camera model {name[:40]} is not supported; undistort the images (colmap "
            f"image_undistorter) or use one of {', '.join(_FOCALS_AND_DISTORTION)}."
        )
    return _FOCALS_AND_DISTORTION[name]


def _posed(
    name: str, pose: Sequence[float], camera_id: int, intrinsics: Mapping[int, _Intrinsics], place: str
) -> tuple[str, Camera]:
    """Image name and camera of quaternion + translation."""
    if not is_plain_text(name):
        raise SourceError(f"{place}: the image name {name!r} contains a NUL.")
    norm = math.hypot(*pose[:4])
    if not all(map(math.isfinite, pose)) or not 1e-6 < norm < 1e6:
        raise SourceError(f"{place}: the pose of {name!r} is not a finite rotation and translation.")
    if camera_id not in intrinsics:
        raise SourceError(f"{place}: {name!r} names the camera {camera_id}, which does not exist.")
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quaternion(pose[:4])
    cam_from_world[:3, 3] = pose[4:]
    name = name.replace("\\", "/")
    own = intrinsics[camera_id]
    camera = Camera(PurePosixPath(name).stem, own.width, own.height, own.K, cam_from_world, own.distortion)
    return name, camera


def _unique(items: Iterator[tuple[Key, Value]], path: Path) -> Iterator[tuple[Key, Value]]:
    seen = set()
    for key, value in items:
        if key in seen:
            raise SourceError(f"{path}: {key!r} appears twice.")
        seen.add(key)
        yield key, value


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, text) of each line, from 1."""
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                yield number, line.strip()
    except OSError as cause:
        raise SourceError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    except UnicodeDecodeError as cause:
        raise SourceError(f"{path} is no text file (byte {cause.start} is not UTF-8).") from cause


def _floats(words: Sequence[str], place: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as cause:
        raise SourceError(f"{place}: {cause}.") from cause


def _integers(words: Sequence[str], place: str) -> list[int]:
    try:
        return [int(word) for word in words]
    except ValueError as cause:
        raise SourceError(f"{place}: {cause}.") from cause


def _text_cameras(path: Path) -> Iterator[tuple[int, _Intrinsics]]:
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        place = f"{path}, line {number}"
        words = line.split()
        if len(words) < 4:
            raise SourceError(f"{place}: a camera has CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters.")
        camera_id, width, height = _integers([words[0], *words[2:4]], place)
        yield camera_id, _intrinsics(words[1], width, height, _floats(words[4:], place), place)


def _text_images(path: Path, intrinsics: Mapping[int, _Intrinsics]) -> Iterator[tuple[str, Camera]]:
    lines = _lines(path)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        place = f"{path}, line {number}"
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise SourceError(
                f"{place}: an image has IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID and NAME."
            )
        (camera_id,) = _integers(words[8:9], place)
        yield _posed(words[9], _floats(words[1:8], place), camera_id, intrinsics, place)
        next(lines, None)  # the image's 2D points, often an empty line


def _text_points(path: Path) -> PointCloud | None:
    rows = []
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=7)
        place = f"{path}, line {number}"
        if len(words) < 7:
            raise SourceError(f"{place}: a point has POINT3D_ID, X, Y, Z, R, G, B and more.")
        rows.append(_floats(words[1:7], place))
    return _cloud(rows, path)


class _Reader:
    """Little-endian values from a file's content; reading past the end is a SourceError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.position = 0
        try:
            self.data = path.read_bytes()
        except OSError as cause:
            raise SourceError(f"{path} cannot be read: {cause.strerror or cause}.") from cause

    def values(self, layout: struct.Struct) -> tuple[float, ...]:
        """The next values of a struct layout."""
        self._need(layout.size)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def count(self, smallest: int) -> int:
        """A number of records, of which each takes at least `smallest` bytes."""
        number = int(self.values(_U64)[0])
        self._need(number * smallest)
        return number

    def text(self) -> str:
        """A NUL-terminated UTF-8 text."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            self._need(len(self.data))
        try:
            text = self.data[self.position : end].decode("utf-8")
        except UnicodeDecodeError as cause:
            raise SourceError(f"{self.path}: the name at byte {self.position} is not UTF-8.") from cause
        self.position = end + 1
        return text

    def skip(self, size: int) -> None:
        """Leaves out bytes whose number a `count` has checked."""
        self.position += size

    def _need(self, size: int) -> None:
        left = len(self.data) - self.position
        if size > left:
            raise SourceError(
                f"{self.path} is damaged or cut short: {size} bytes should follow byte {self.position}, "
                f"{left} do."
            )


_U64 = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera id
_POINT = struct.Struct("<Q3d3Bd")  # id, position, colour, error


def _binary_cameras(reader: _Reader) -> Iterator[tuple[int, _Intrinsics]]:
    for _ in range(reader.count(_CAMERA.size)):
        camera_id, model, width, height = (int(value) for value in reader.values(_CAMERA))
        place = f"{reader.path}, camera {camera_id}"
        name = _MODEL_NAMES[model] if 0 <= model < len(_MODEL_NAMES) else f"number {model}"
        focals, order = _model(name, place)
        parameters = reader.values(struct.Struct(f"<{focals + 2 + len(order)}d"))
        yield camera_id, _intrinsics(name, width, height, parameters, place)


def _binary_images(reader: _Reader, intrinsics: Mapping[int, _Intrinsics]) -> Iterator[tuple[str, Camera]]:
    for _ in range(reader.count(_IMAGE.size + 9)):
        image_id, *pose, camera_id = reader.values(_IMAGE)
        name = reader.text()
        reader.skip(24 * reader.count(24))  # 2D points: x, y, 3D point
        yield _posed(name, pose, int(camera_id), intrinsics, f"{reader.path}, image {int(image_id)}")


def _binary_points(path: Path) -> PointCloud | None:
    reader = _Reader(path)
    rows = []
    for _ in range(reader.count(_POINT.size + 8)):
        rows.append(reader.values(_POINT)[1:7])
        reader.skip(8 * reader.count(8))  # track: image, 2D point
    return _cloud(rows, path)


def _cloud(rows: Sequence[Sequence[float]], path: Path) -> PointCloud | None:
    """Points and colours of rows x, y, z, r, g, b."""
    if not rows:
        return None
    table = np.array(rows, dtype=np.float64)
    if not np.isfinite(table).all():
        raise SourceError(f"{path}: a point's position is not finite.")
    return PointCloud(table[:, :3], colors=np.clip(table[:, 3:] / 255.0, 0.0, 1.0).astype(np.float32))
