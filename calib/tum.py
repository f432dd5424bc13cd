"""Response and flat field in the files of TUM's photometric calibration (Engel, Usenko and Cremers 2016).

    pcalib.txt      256 numbers: what is proportional to the exposure, for each stored value; 0..255
    vignette.png    grey, 8 or 16 bits: what the lens passes, 1 = the largest number

Both are of cameras with one channel: a response that differs between channels is written as that of green,
and one that is read holds for all. Stored values there include the dark level; it goes into the curve when it
is written, and cannot be taken out again when it is read. Our flat field is radial; a vignette that is not,
is refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
from calib.errors import LensFileError
from capture.atomic import atomic_write
from capture.controls import Controls
from capture.errors import ImageError
from capture.images import read_image, write_png
from capture.radiometry import Radiometry
from capture.response import Response

Floats = NDArray[np.float64]

_CODES = 256
_LARGEST_FILE = 1 << 16
_TERMS = 3
_LARGEST_OFF = 0.02  # of what a lens passes, that a radial curve may leave


def is_pcalib(path: Path) -> bool:
    """Whether a file is named as TUM's response is."""
    return path.suffix.lower() == ".txt" and "pcalib" in path.stem.lower()


def is_vignette(path: Path) -> bool:
    """Whether a file is named as TUM's vignette is."""
    return path.suffix.lower() == ".png"


def read_pcalib(path: Path) -> Response:
    """The response of a pcalib.txt.

    Raises:
        LensFileError: missing, or not 256 numbers that rise.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise LensFileError(f"{path} is larger than {_LARGEST_FILE >> 10} KiB, which no pcalib.txt is.")
        values = np.array([float(word) for word in path.read_text(encoding="utf-8").split()])
    except OSError as cause:
        raise LensFileError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    except ValueError as cause:
        raise LensFileError(f"{path} holds something else than numbers: {cause}.") from cause
    if values.shape != (_CODES,) or not np.isfinite(values).all():
        raise LensFileError(f"{path} holds {len(values)} numbers; a response has {_CODES}, all finite.")
    if not (np.diff(values) >= 0).all() or not values[-1] > max(values[0], 0.0):
        raise LensFileError(f"{path}: the numbers must rise from the darkest to the brightest stored value.")
    linear = np.maximum(values - values[0], 0.0) / (values[-1] - values[0])
    return Response(None, np.linspace(0.0, 1.0, _CODES), linear, f"{path.name} (TUM)")


def write_pcalib(calibration: Calibration, path: Path) -> None:
    """Writes the response, and the dark level in it.

    Raises:
        LensFileError: no response is known.
    """
    if calibration.response is None:
        raise LensFileError("The calibration has no response; make one with `relight calibrate response`.")
    dark = None if calibration.dark is None else calibration.dark.value
    codes = np.repeat(np.arange(_CODES, dtype=np.uint8)[:, None], 3, axis=1)[None]
    green = Radiometry(calibration.response, dark).exposure(codes)[0, :, 1].astype(np.float64)
    values = 255.0 * np.maximum(green, 0.0) / green[-1]
    atomic_write(path, (" ".join(f"{value:.6f}" for value in values) + "\n").encode())


def read_vignette(path: Path) -> Quantity:
    """The flat field of a vignette.png.

    Raises:
        LensFileError: missing, coloured, or not radial.
    """
    try:
        picture = read_image(path)
    except ImageError as cause:
        raise LensFileError(str(cause)) from cause
    if picture.ndim != 2 or picture.dtype not in (np.uint8, np.uint16) or min(picture.shape) < 8:
        raise LensFileError(f"{path} must be a grey picture of 8 or 16 bits and at least 8 x 8 pixels.")
    height, width = picture.shape
    # Every so many pixels are enough: the curve has four numbers.
    step = max(1, max(height, width) // 200)
    y, x = np.mgrid[0:height:step, 0:width:step]
    r2 = 4.0 * ((x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2) / (width**2 + height**2)
    passed = picture[::step, ::step].astype(np.float64).ravel() / np.iinfo(picture.dtype).max
    if not passed.max() > 0:
        raise LensFileError(f"{path} is black: a lens that passes nothing takes no pictures.")
    powers = np.stack([r2.ravel() ** k for k in range(_TERMS + 1)], axis=1)
    # Mended where it is dark by noise, or blind behind the lens's own rim.
    seen = passed > 0.05
    found = np.linalg.lstsq(powers[seen], passed[seen], rcond=None)[0]
    off = np.abs(powers[seen] @ found / passed[seen] - 1.0)
    if np.percentile(off, 95) > _LARGEST_OFF or not found[0] > 0:
        raise LensFileError(
            f"{path} is not radial: a curve by the distance from the centre leaves "
            f"{np.percentile(off, 95):.1%} (at most {_LARGEST_OFF:.0%}), and no other is known here."
        )
    made_with = Controls(width=width, height=height)
    return Quantity.of(found[1:] / found[0], "1", f"{path.name} (TUM)", None, made_with)


def write_vignette(calibration: Calibration, path: Path) -> None:
    """Writes the flat field as a picture of 16 bits, of the size that it was made with.

    Raises:
        LensFileError: no flat field is known, or not for which size of pictures.
    """
    flat = calibration.flat_field
    if flat is None:
        raise LensFileError("The calibration has no flat field; make one with `relight calibrate flat`.")
    made_with = flat.made_with
    lens = calibration.intrinsics
    size = (None, None) if made_with is None else (made_with.width, made_with.height)
    if None in size and lens is not None:
        size = (lens.width, lens.height)
    width, height = size
    if width is None or height is None:
        raise LensFileError(
            "The calibration does not say for which size of pictures its flat field was made."
        )
    passed = Radiometry(Response("linear"), flat_field=flat.value).passed(height, width)
    write_png(path, np.rint(65535.0 * np.clip(passed / passed.max(), 0.0, 1.0)).astype(np.uint16))


def convert_tum(source: Path, out: Path) -> str:
    """Brings a response or a flat field from or to TUM's files.

    Returns:
        What it was, for people.

    Raises:
        LensFileError: neither file is one of TUM's, or both are; or as above.
        CalibrationError: a calibration.json that is malformed.
    """
    theirs = [path for path in (source, out) if is_pcalib(path) or is_vignette(path)]
    if len(theirs) != 1:
        raise LensFileError(
            f"Of {source} and {out} one must be a calibration.json, the other one of TUM's files."
        )
    if theirs[0] == source:
        known = Calibration(response=read_pcalib(source)) if is_pcalib(source) else None
        save_calibration(known or Calibration(flat_field=read_vignette(source)), out)
    else:
        if not source.is_file():
            raise LensFileError(f"{source} does not exist.")
        (write_pcalib if is_pcalib(out) else write_vignette)(load_calibration(source), out)
    return "response" if is_pcalib(theirs[0]) else "flat field"
