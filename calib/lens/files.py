"""Intrinsics in the files of other tools: OpenCV and ROS YAML, COLMAP cameras.txt, Kalibr camchain, mrcal.

    tool     file            pixel (0, 0) is           distortion
    ours     calibration.json  the top left corner     k1, k2, p1, p2, k3, k4, k5, k6 (OpenCV's order)
    OpenCV   .yml, .yaml     the top left pixel's centre  as ours; in ROS plumb_bob or rational_polynomial
    Kalibr   camchain .yaml  as OpenCV                 radtan: k1, k2, p1, p2
    mrcal    .cameramodel    as OpenCV                 LENSMODEL_OPENCV4, 5 and 8
    COLMAP   cameras.txt     the top left corner       OPENCV: k1, k2, p1, p2; FULL_OPENCV: eight

The half pixel between the two is added and taken off here, once. Files are parsed, never run. What a model
cannot hold is refused, never dropped.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, Intrinsics, Quantity, load_calibration, save_calibration
from calib.errors import LensFileError
from calib.lens.yaml_subset import parse_yaml
from capture.atomic import atomic_write
from capture.cameras import LARGEST_SIDE
from capture.json_fields import Fields

Floats = NDArray[np.float64]

#: Formats by name, with the end of a file's name that is taken for them when it is written.
FORMATS = {
    "relight": ".json",
    "opencv": ".yml",
    "colmap": ".txt",
    "kalibr": ".yaml",
    "mrcal": ".cameramodel",
}
_LARGEST_FILE = 1 << 24  # bytes; a .cameramodel with its optimisation's inputs is a few megabytes
_CENTRE = 0.5  # our pixel coordinates minus OpenCV's
_SHIFT = np.array([0.0, 0.0, _CENTRE, _CENTRE])
# COLMAP's models that we can express: number of focal lengths, places of the distortion in OpenCV's order.
_COLMAP: dict[str, tuple[int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (0,)),
    "RADIAL": (1, (0, 1)),
    "OPENCV": (2, (0, 1, 2, 3)),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7)),
}
_MRCAL = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5, "LENSMODEL_OPENCV8": 8}
_ROS = {"plumb_bob": 5, "rational_polynomial": 8}


def read_lens(path: Path, camera: str | None = None) -> Intrinsics:
    """The intrinsics of a file, whose format its content tells.

    Args:
        path: the file.
        camera: which one of several (Kalibr's cam0, COLMAP's number); None = the only one.

    Raises:
        LensFileError: missing, malformed, with several cameras, or with a lens that our model does not have.
        CalibrationError: a calibration.json that is malformed.
    """
    path = Path(path)
    text = _text_of(path)
    if path.suffix.lower() == ".json":
        return _read_ours(path)
    if path.suffix.lower() == ".txt":
        return _read_colmap(path, text, camera)
    if re.search(r"LENSMODEL_", text):
        return _read_mrcal(path, text)
    try:
        content = parse_yaml(text)
    except ValueError as cause:
        raise LensFileError(f"{path} is no calibration that is known here: {cause}.") from cause
    if not isinstance(content, dict):
        raise LensFileError(f"{path} holds a list; a calibration is a mapping of names to values.")
    if "camera_matrix" in content or "cameraMatrix" in content:
        return _read_opencv(path, content)
    if any(isinstance(part, dict) and "camera_model" in part for part in content.values()):
        return _read_kalibr(path, content, camera)
    raise LensFileError(
        f"{path} holds no intrinsics that are known here (OpenCV's camera_matrix, Kalibr's cam0, mrcal's "
        "lensmodel, COLMAP's cameras.txt, or a calibration.json)."
    )


def write_lens(intrinsics: Intrinsics, path: Path, form: str | None = None) -> None:
    """Writes intrinsics for another tool, or into a calibration.json, whose other entries stay.

    Args:
        intrinsics: what to write.
        path: the file.
        form: a name of `FORMATS`; None = by the end of the file's name.

    Raises:
        LensFileError: the format is unknown or cannot hold this lens.
    """
    path = Path(path)
    if form is None:
        form = next((name for name, suffix in FORMATS.items() if path.suffix.lower() == suffix), None)
    if form not in FORMATS:
        known = ", ".join(f"{name} ({suffix})" for name, suffix in FORMATS.items())
        raise LensFileError(f"{path}: the format is not told by the name; there are {known}.")
    if form == "relight":
        save_calibration(Calibration(intrinsics=intrinsics), path)
        return
    writers: dict[str, Callable[[Intrinsics], str]] = {
        "opencv": _opencv_text,
        "colmap": _colmap_text,
        "kalibr": _kalibr_text,
        "mrcal": _mrcal_text,
    }
    atomic_write(path, writers[form](intrinsics).encode())


def _text_of(path: Path) -> str:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise LensFileError(f"{path} is larger than {_LARGEST_FILE >> 20} MiB, which no calibration is.")
        return path.read_text(encoding="utf-8")
    except OSError as cause:
        raise LensFileError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    except UnicodeDecodeError as cause:
        raise LensFileError(f"{path} is no text (byte {cause.start} is not UTF-8).") from cause


def _read_ours(path: Path) -> Intrinsics:
    intrinsics = load_calibration(path).intrinsics
    if intrinsics is None:
        raise LensFileError(f"{path} has no intrinsics; make them with `relight calibrate intrinsics`.")
    return intrinsics


def _intrinsics(
    path: Path, size: Sequence[float], pinhole: Sequence[float], distortion: Sequence[float], what: str
) -> Intrinsics:
    """Checked; `pinhole` is in our pixels."""
    numbers = np.array([*size, *pinhole, *distortion], dtype=np.float64)
    if len(size) != 2 or len(pinhole) != 4 or not np.isfinite(numbers).all():
        raise LensFileError(f"{path}: size, focal lengths, centre or distortion are no finite numbers.")
    width, height = int(numbers[0]), int(numbers[1])
    if (width, height) != tuple(size) or not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise LensFileError(f"{path}: the picture size {size[0]:g} x {size[1]:g} is impossible.")
    if not (pinhole[0] > 0 and pinhole[1] > 0):
        raise LensFileError(f"{path}: the focal lengths {pinhole[0]:g} and {pinhole[1]:g} must be positive.")
    terms = np.array(distortion, dtype=np.float64)
    if terms[8:].any():
        raise LensFileError(
            f"{path}: thin prism or tilt terms are not supported; calibrate with eight terms or fewer."
        )
    terms = terms[:8]
    length = next((n for n in (0, 4, 5, 8) if not terms[n:].any()), 8)
    padded = np.zeros(max(length, 4))
    padded[: min(len(terms), len(padded))] = terms[: len(padded)]
    source = f"{path.name} ({what})"
    return Intrinsics(
        width,
        height,
        Quantity.of(pinhole, "px", source),
        Quantity.of(padded, "1", source) if length else None,
    )


def _read_opencv(path: Path, content: dict[str, Any]) -> Intrinsics:
    fields = Fields(content, str(path), LensFileError)
    K = _matrix(fields, "camera_matrix" if "camera_matrix" in content else "cameraMatrix", (3, 3))
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]) or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise LensFileError(
            f"{path}: the camera matrix has skew or another form than fx 0 cx, 0 fy cy, 0 0 1."
        )
    model = content.get("distortion_model", "plumb_bob")
    if model not in _ROS:
        raise LensFileError(
            f"{path}: the distortion model {str(model)[:40]!r} is not supported; {' and '.join(_ROS)} are."
        )
    if fisheye := next((key for key in ("fisheye_model", "xi") if content.get(key)), None):
        raise LensFileError(f"{path}: {fisheye!r} says that this is a fisheye or omnidirectional lens.")
    names = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion")
    name = next((name for name in names if name in content), None)
    terms = np.zeros(0) if name is None else _matrix(fields, name, (None, None)).ravel()
    size = [
        next((content[key] for key in keys if isinstance(content.get(key), float)), None)
        for keys in (("image_width", "width"), ("image_height", "height"))
    ]
    if None in size:
        raise LensFileError(f"{path} does not say image_width and image_height; add them.")
    pinhole = [K[0, 0], K[1, 1], K[0, 2] + _CENTRE, K[1, 2] + _CENTRE]
    return _intrinsics(
        path, [float(side) for side in size if side is not None], pinhole, terms.tolist(), "OpenCV"
    )


def _matrix(fields: Fields, key: str, shape: tuple[int | None, ...]) -> Floats:
    """OpenCV's and ROS's rows, cols, data; or nested lists."""
    value = fields.values.get(key)
    if isinstance(value, dict):
        entry = fields.child(key)
        rows, columns = entry.integer("rows", low=0, high=100), entry.integer("cols", low=0, high=100)
        data = entry.array("data", (None,))
        if len(data) != rows * columns:
            raise entry.fail(f"{rows} x {columns} numbers are announced and {len(data)} are there.")
        matrix: Floats = data.reshape(rows, columns)
        if shape != (None, None) and matrix.shape != shape:
            raise entry.fail(f"it is {rows} x {columns}; it must be {shape[0]} x {shape[1]}.")
        return matrix
    if shape == (None, None) and isinstance(value, list) and not any(isinstance(v, list) for v in value):
        flat: Floats = fields.array(key, (None,))
        return flat[None]
    nested: Floats = fields.array(key, shape)
    return nested


def _read_kalibr(path: Path, content: dict[str, Any], camera: str | None) -> Intrinsics:
    cameras = {
        name: part for name, part in content.items() if isinstance(part, dict) and "camera_model" in part
    }
    name = _chosen(path, cameras, camera)
    fields = Fields(cameras[name], f"{path}: {name}", LensFileError)
    model, bends = fields.text("camera_model"), fields.text("distortion_model", "none")
    if model != "pinhole" or bends not in ("radtan", "none"):
        raise fields.fail(f"the model {model}-{bends} is not supported; pinhole-radtan and pinhole-none are.")
    pinhole = fields.array("intrinsics", (4,)) + _SHIFT
    terms = fields.array("distortion_coeffs", (4,)) if bends == "radtan" else np.zeros(0)
    size = fields.array("resolution", (2,))
    return _intrinsics(path, size.tolist(), pinhole.tolist(), terms.tolist(), f"Kalibr {name}")


def _read_mrcal(path: Path, text: str) -> Intrinsics:
    try:
        content = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as cause:
        raise LensFileError(
            f"{path} is no .cameramodel: it must hold one mapping of plain values."
        ) from cause
    if not isinstance(content, dict):
        raise LensFileError(f"{path} is no .cameramodel: it holds no mapping.")
    fields = Fields({str(key): value for key, value in content.items()}, str(path), LensFileError)
    model = fields.text("lensmodel" if "lensmodel" in fields else "lens_model")
    if model not in _MRCAL:
        raise fields.fail(
            f"the model {model[:60]} is not supported; convert it first: mrcal-convert-lensmodel "
            "LENSMODEL_OPENCV8."
        )
    values = fields.array("intrinsics", (None,))
    if len(values) != 4 + _MRCAL[model]:
        raise fields.fail(f"{model} has {4 + _MRCAL[model]} intrinsics, not {len(values)}.")
    values[2:4] += _CENTRE
    size = fields.array("imagersize", (2,))
    return _intrinsics(path, size.tolist(), values[:4].tolist(), values[4:].tolist(), f"mrcal {model}")


def _read_colmap(path: Path, text: str, camera: str | None) -> Intrinsics:
    cameras: dict[str, list[str]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or words[0] in cameras:
            raise LensFileError(
                f"{path}, line {number}: a camera has a number of its own, model, width, height and "
                "parameters."
            )
        cameras[words[0]] = words[1:]
    model, *rest = cameras[_chosen(path, cameras, camera)]
    if model not in _COLMAP:
        raise LensFileError(f"{path}: the model {model[:40]} is not supported; {', '.join(_COLMAP)} are.")
    try:
        width, height, *values = (float(word) for word in rest)
    except ValueError as cause:
        raise LensFileError(f"{path}: {cause}.") from cause
    focals, places = _COLMAP[model]
    if len(values) != focals + 2 + len(places):
        raise LensFileError(f"{path}: {model} has {focals + 2 + len(places)} parameters, not {len(values)}.")
    terms = np.zeros(8)
    terms[list(places)] = values[focals + 2 :]
    pinhole = [values[0], values[focals - 1], *values[focals : focals + 2]]
    return _intrinsics(path, [width, height], pinhole, terms.tolist(), f"COLMAP {model}")


def _chosen(path: Path, cameras: dict[str, Any], camera: str | None) -> str:
    if camera is not None and camera in cameras:
        return camera
    names = ", ".join(list(cameras)[:20])
    if camera is not None:
        raise LensFileError(f"{path} has no camera {camera!r}; it has {names or 'none'}.")
    if len(cameras) != 1:
        raise LensFileError(f"{path} has {len(cameras)} cameras ({names}); name one with --camera.")
    return next(iter(cameras))


def _terms(intrinsics: Intrinsics, tool: str, lengths: Sequence[int]) -> Floats:
    """The distortion, filled up to the first of some lengths that holds it."""
    values = np.zeros(0) if intrinsics.distortion is None else np.trim_zeros(intrinsics.distortion.value, "b")
    length = next((n for n in lengths if n >= len(values)), None)
    if length is None:
        raise LensFileError(
            f"{tool} holds {lengths[-1]} distortion terms and this lens has {len(values)}; take another "
            "format "
            "or calibrate with --model k1k2p1p2."
        )
    return np.concatenate([values, np.zeros(length - len(values))])


def _numbers(values: Sequence[float] | Floats) -> str:
    return ", ".join(repr(float(value)) for value in values)


def _opencv_text(intrinsics: Intrinsics) -> str:
    fx, fy, cx, cy = intrinsics.pinhole.value - _SHIFT
    terms = _terms(intrinsics, "OpenCV", (4, 5, 8))
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {intrinsics.width}\nimage_height: {intrinsics.height}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {_numbers([fx, 0.0, cx])},\n       {_numbers([0.0, fy, cy])},\n       0., 0., 1. ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: {len(terms)}\n   dt: d\n"
        f"   data: [ {_numbers(terms)} ]\n"
    )


def _kalibr_text(intrinsics: Intrinsics) -> str:
    pinhole = intrinsics.pinhole.value - _SHIFT
    terms = _terms(intrinsics, "Kalibr's radtan", (4,))
    return (
        "cam0:\n  camera_model: pinhole\n"
        f"  intrinsics: [{_numbers(pinhole)}]\n"
        f"  distortion_model: radtan\n  distortion_coeffs: [{_numbers(terms)}]\n"
        f"  resolution: [{intrinsics.width}, {intrinsics.height}]\n"
    )


def _mrcal_text(intrinsics: Intrinsics) -> str:
    pinhole = intrinsics.pinhole.value - _SHIFT
    terms = _terms(intrinsics, "mrcal", (0, 4, 5, 8))
    model = next(name for name, length in _MRCAL.items() if length == len(terms))
    return (
        "{\n"
        f"    'lensmodel': '{model}',\n"
        f"    'intrinsics': [ {_numbers([*pinhole, *terms])} ],\n"
        "    'extrinsics': [ 0., 0., 0., 0., 0., 0. ],\n"
        f"    'imagersize': [ {intrinsics.width}, {intrinsics.height} ]\n"
        "}\n"
    )


def _colmap_text(intrinsics: Intrinsics) -> str:
    terms = _terms(intrinsics, "COLMAP", (0, 4, 8))
    model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[len(terms)]
    values = " ".join(repr(float(value)) for value in [*intrinsics.pinhole.value, *terms])
    return (
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {intrinsics.width} {intrinsics.height} {values}\n"
    )
