"""The transforms.json of nerfstudio, instant-ngp and Blender sets.

Specification: https://docs.nerf.studio/quickstart/data_conventions.html

`transform_matrix` is world-from-camera in OpenGL axes (x right, y up, z backwards). `applied_transform` and
`applied_scale` say how the tool moved the original reconstruction; they are undone, for poses and cloud
alike, so that the session's world is the original one, in which the user's other clouds lie.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capture.cameras import LARGEST_SIDE, Camera, check_intrinsics, check_rotation, nearest_rotation
from capture.errors import ImageError, SourceError
from capture.images import image_size
from capture.importers.image_set import write_image_set
from capture.importers.options import ImportOptions, Progress
from capture.importers.source_frame import SourceFrame
from capture.json_fields import Fields, read_json
from capture.ply import PointCloud, read_ply
from capture.session import Session

_PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FARTHEST = 1e30  # world units; float32, which clouds commonly have, ends at 3e38
_LARGEST_SCALE = 1e9  # between a reconstruction's units and the file's
_CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def import_nerfstudio(path: Path, out: Path, options: ImportOptions, progress: Progress) -> Session:
    """Makes a session of a transforms.json. Frames keep the order of the file.

    A frame's flash is its own key "flash" (1, 0 or null), or the flash list, or unknown.

    Raises:
        SourceError: the file is malformed, or a picture, mask or cloud is missing or does not fit.
    """
    fields = read_json(path, SourceError)
    file_from_original = _file_from_original(fields)
    entries = list(fields.children("frames", "frame"))
    if not entries:
        raise fields.fail('"frames" is empty: there is no camera to use.')
    splits = _splits(fields)
    frames = []
    for index, entry in enumerate(entries):
        name = _file_name(entry, path.parent)
        picture = path.parent / name
        camera = _camera(entry, fields, picture, file_from_original)
        mask = entry.text("mask_path", None)
        frames.append(
            SourceFrame(
                index=index,
                name=name,
                picture=picture,
                size=(camera.width, camera.height),
                camera=camera,
                flash=entry.integer("flash", None, 0, 1),
                split=splits.get(name),
                mask=path.parent / mask if mask else None,
            )
        )
    return write_image_set(
        out,
        frames,
        source={"kind": "nerfstudio", "path": str(path), "units": "arbitrary"},
        transfer="srgb",
        cloud=_cloud(fields, path.parent, file_from_original),
        options=options,
        progress=progress,
    )


def _file_name(entry: Fields, root: Path) -> str:
    """A frame's picture relative to the file; Blender's sets leave out .png."""
    name: str = entry.text("file_path").replace("\\", "/").removeprefix("./")
    return name if Path(name).suffix or (root / name).is_file() else f"{name}.png"


def _splits(fields: Fields) -> dict[str, str]:
    """Split by picture name, from the lists that nerfstudio knows."""
    splits: dict[str, str] = {}
    for split in ("train", "val"):
        names = fields.values.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise fields.fail(f'"{split}_filenames" must be a list of file names.')
        splits |= {name.removeprefix("./"): split for name in names}
    return splits


def _camera(entry: Fields, shared: Fields, picture: Path, file_from_original: NDArray[np.float64]) -> Camera:
    both = Fields({**shared.values, **entry.values}, entry.place, entry.error)
    model = both.text("camera_model", "OPENCV")
    if model not in _PINHOLE_MODELS:
        raise entry.fail(
            f"the camera model {model[:40]} is not supported; undistort the pictures to a pinhole first."
        )
    width, height = both.integer("w", None, 1, LARGEST_SIDE), both.integer("h", None, 1, LARGEST_SIDE)
    if width is None or height is None:
        try:
            width, height = image_size(picture)
        except ImageError as cause:
            raise entry.fail(str(cause)) from cause
    K = _intrinsics(both, width, height)
    return Camera(picture.stem, width, height, K, _pose(entry, file_from_original), _distortion(both))


def _intrinsics(fields: Fields, width: int, height: int) -> NDArray[np.float64]:
    focal = fields.number("fl_x", None)
    if focal is None:
        angle = fields.number("camera_angle_x")
        if not 0 < angle < math.pi:
            raise fields.fail(f'"camera_angle_x" is {angle:g} rad, not between 0 and pi.')
        focal = width / 2 / math.tan(angle / 2)
    K = np.array(
        [
            [focal, 0.0, fields.number("cx", width / 2)],
            [0.0, fields.number("fl_y", focal), fields.number("cy", height / 2)],
            [0.0, 0.0, 1.0],
        ]
    )
    if complaint := check_intrinsics(K):
        raise fields.fail(f"{complaint}.")
    return K


def _distortion(fields: Fields) -> NDArray[np.float64]:
    """In OpenCV's order k1, k2, p1, p2, k3."""
    if fields.number("k4", 0.0):
        raise fields.fail("a fourth radial distortion (k4) is not supported; undistort the pictures first.")
    distortion = np.array([fields.number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    return distortion if distortion.any() else np.zeros(0)


def _pose(entry: Fields, file_from_original: NDArray[np.float64]) -> NDArray[np.float64]:
    world_from_gl = entry.affine("transform_matrix")
    if complaint := check_rotation(world_from_gl[:3, :3]):
        raise entry.fail(f"{complaint}.")
    world_from_gl[:3, :3] = nearest_rotation(world_from_gl[:3, :3])
    cam_from_original: NDArray[np.float64] = _CV_FROM_GL @ np.linalg.inv(world_from_gl) @ file_from_original
    scale = np.cbrt(np.linalg.det(cam_from_original[:3, :3]))
    cam_from_original[:3] /= scale  # camera axes in the original's unit of length
    if not np.abs(cam_from_original).max() < _FARTHEST:
        raise entry.fail("the camera's position is out of any range.")
    cam_from_original[:3, :3] = nearest_rotation(cam_from_original[:3, :3])
    return cam_from_original


def _file_from_original(fields: Fields) -> NDArray[np.float64]:
    """[4, 4] similarity from the original reconstruction's world to the file's."""
    matrix = fields.affine("applied_transform") if "applied_transform" in fields else np.eye(4)
    matrix[:3] *= fields.number("applied_scale", 1.0)
    if np.abs(matrix).max() < _LARGEST_SCALE:
        scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
        if scale > 1.0 / _LARGEST_SCALE and not check_rotation(matrix[:3, :3] / scale):
            return matrix
    raise fields.fail("applied_transform and applied_scale must be a rotation, a positive scale and a shift.")


def _cloud(fields: Fields, root: Path, file_from_original: NDArray[np.float64]) -> PointCloud | None:
    name = fields.text("ply_file_path", None)
    if name is None:
        return None
    cloud = read_ply(root / name)
    original_from_file = np.linalg.inv(file_from_original)
    points = cloud.points @ original_from_file[:3, :3].T + original_from_file[:3, 3]
    if not np.abs(points).max() < _FARTHEST:
        raise fields.fail(f"applied_transform and applied_scale move points of {name} out of any range.")
    normals = cloud.normals
    if normals is not None:
        scale = np.cbrt(np.linalg.det(file_from_original[:3, :3]))
        normals = (normals @ (original_from_file[:3, :3].T * scale)).astype(np.float32)
    return PointCloud(points.astype(cloud.points.dtype), normals, cloud.colors)
