"""Named transfer functions: from stored pixel values to linear radiance and back.

A name is one of

    linear              stored values are proportional to radiance
    srgb                IEC 61966-2-1
    rec709              ITU-R BT.709, with the exact constants of BT.2020 (continuous at the knee)
    gamma:G             encoded = linear^(1/G)
    log:A               encoded = log(1 + A linear) / log(1 + A)
    jtvideo, jtlog, jtlog2   the tabulated profiles of the Open Camera app, piecewise linear

`gamma` and `log` take an optional `@N`: the curve as a camera applies it that was given N evenly spaced
control points and interpolates linearly between them (Android's TONEMAP_CURVE). Open Camera sends 64 points,
32 on Samsung phones; at the dark end of a strong log profile the difference is large.

1.0 is the white clip of the stored frame on both sides.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.errors import TransferError

Curve = Callable[[NDArray[np.float64]], NDArray[np.float64]]

# ITU-R BT.2020-2, table 4: alpha and beta solve "value and slope agree at the knee"; BT.709 prints them
# rounded (1.099, 0.018), which leaves a step of 2.5e-4 there.
_ALPHA_709 = 1.09929682680944
_BETA_709 = 0.018053968510807

# Control points (linear, encoded) of Open Camera's three tabulated video profiles, in percent.
_OPEN_CAMERA_TABLES: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "jtvideo": (
        (0, 1, 2, 5, 9, 13, 18, 28, 35, 45, 51, 60, 67, 77, 88, 97, 100),
        (0, 5.5, 10, 21, 31, 38, 45, 57, 64, 72, 76, 82, 86, 91, 96, 99, 100),
    ),
    "jtlog": (
        (0, 1, 3, 5, 7, 9, 13, 18, 24, 31, 38, 46, 58, 70, 86, 99, 100),
        (0, 7, 17, 25, 31, 36, 44, 51, 57, 64, 70, 76, 83, 89, 95, 99, 100),
    ),
    "jtlog2": (
        (0, 1, 3, 7, 12, 17, 25, 32, 39, 50, 59, 66, 72, 78, 88, 92, 99, 100),
        (0, 9, 23, 37, 48, 56, 64, 70, 75, 81, 85, 88, 90, 92, 95, 96, 98, 100),
    ),
}

#: Open Camera's setting `preference_video_log` -> transfer name. "gamma" needs the value of
#: `preference_video_profile_gamma` and "off" is the phone's own unknown curve, so neither is listed.
OPEN_CAMERA_PROFILES = {
    "rec709": "rec709",
    "srgb": "srgb",
    "fine": "log:10@64",
    "low": "log:32@64",
    "medium": "log:100@64",
    "strong": "log:224@64",
    "extra_strong": "log:500@64",
    "jtvideo": "jtvideo",
    "jtlog": "jtlog",
    "jtlog2": "jtlog2",
}

_ALIASES = {
    "srgb": "srgb",
    "srgbiec6196621": "srgb",
    "iec6196621": "srgb",
    "rec709": "rec709",
    "bt709": "rec709",
    "linear": "linear",
    "jtvideo": "jtvideo",
    "jtlog": "jtlog",
    "jtlog2": "jtlog2",
}

_PARAMETRIC = re.compile(r"(gamma|log):([0-9]+(?:\.[0-9]+)?)(?:@([0-9]{1,5}))?")
_PARAMETER_LIMITS = {"gamma": (0.1, 10.0), "log": (0.001, 1e6)}


def canonical_transfer(name: str) -> str:
    """The one spelling of a transfer function's name, e.g. "sRGB (IEC 61966-2-1)" -> "srgb".

    Raises:
        TransferError: the name is unknown or its parameter is out of range.
    """
    text = str(name).strip().lower()
    if alias := _ALIASES.get(re.sub(r"[^a-z0-9]", "", text)):
        return alias
    match = _PARAMETRIC.fullmatch(text)
    if match is None:
        raise TransferError(
            f"Transfer function {name!r} is not known; use linear, srgb, rec709, gamma:G (as gamma:2.2), "
            "log:A (as log:100), jtvideo, jtlog or jtlog2, or calibrate the response."
        )
    kind, value, points = match.group(1), float(match.group(2)), match.group(3)
    low, high = _PARAMETER_LIMITS[kind]
    if not low <= value <= high:
        raise TransferError(f"Transfer function {name!r}: the parameter must lie in {low:g}..{high:g}.")
    if points is not None and int(points) < 2:
        raise TransferError(f"Transfer function {name!r}: at least 2 control points are needed.")
    return f"{kind}:{value:.12g}" + (f"@{int(points)}" if points is not None else "")


def to_linear(values: ArrayLike, transfer: str) -> NDArray[np.float32]:
    """Linear radiance of stored values.

    Args:
        values: any shape; unsigned integers are scaled by the largest value of their type, floats are taken
            as 0..1. Negative floats become 0; floats above 1 follow the curve on (a tabulated curve ends at
            1).
        transfer: a name of this module's list.

    Returns:
        float32, the shape of `values`; 1.0 = white clip.
    """
    name = canonical_transfer(transfer)
    array = np.asarray(values)
    if array.dtype in (np.uint8, np.uint16):
        # "clip" never clips here: it spares the bounds check, three times faster than plain indexing.
        return np.take(_decoding_table(name, array.dtype.name), array, mode="clip")
    if not np.issubdtype(array.dtype, np.floating):
        raise TransferError(
            f"Pixel values of type {array.dtype} cannot be linearised; use uint8, uint16 or float."
        )
    if name == "linear":
        return np.maximum(array, 0).astype(np.float32)
    decode, _ = _curves(name)
    return decode(np.maximum(array, 0).astype(np.float64)).astype(np.float32)


def to_display(linear: ArrayLike, transfer: str = "srgb") -> NDArray[np.float32]:
    """Stored values of linear radiance: float32 in 0..1, the shape of `linear`, clipped at both ends."""
    _, encode = _curves(canonical_transfer(transfer))
    return encode(np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)).astype(np.float32)


@lru_cache(maxsize=32)
def _decoding_table(name: str, dtype: str) -> NDArray[np.float32]:
    """Linear value of every code of an unsigned integer type: [256] or [65536]."""
    decode, _ = _curves(name)
    largest = np.iinfo(dtype).max
    table = decode(np.arange(largest + 1, dtype=np.float64) / largest).astype(np.float32)
    table.flags.writeable = False
    return table


@lru_cache(maxsize=64)
def _curves(name: str) -> tuple[Curve, Curve]:
    """(decode, encode) of a canonical name, for values >= 0."""
    if name in _OPEN_CAMERA_TABLES:
        linear, encoded = (np.array(column) / 100.0 for column in _OPEN_CAMERA_TABLES[name])
        return _tabulated(linear, encoded)
    if name == "linear":
        return (lambda encoded: encoded), (lambda linear: linear)
    if name == "srgb":
        return _srgb_decode, _srgb_encode
    if name == "rec709":
        return _rec709_decode, _rec709_encode
    kind, _, rest = name.partition(":")
    value, _, points = rest.partition("@")
    decode, encode = _gamma(float(value)) if kind == "gamma" else _log(float(value))
    if points:
        linear = np.linspace(0.0, 1.0, int(points))
        return _tabulated(linear, encode(linear))
    return decode, encode


def _tabulated(linear: NDArray[np.float64], encoded: NDArray[np.float64]) -> tuple[Curve, Curve]:
    return (lambda values: np.interp(values, encoded, linear)), (
        lambda values: np.interp(values, linear, encoded)
    )


def _gamma(exponent: float) -> tuple[Curve, Curve]:
    return (lambda encoded: encoded**exponent), (lambda linear: linear ** (1.0 / exponent))


def _log(strength: float) -> tuple[Curve, Curve]:
    span = np.log1p(strength)
    return (
        lambda encoded: np.expm1(encoded * span) / strength,
        lambda linear: np.log1p(strength * linear) / span,
    )


def _srgb_decode(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _srgb_encode(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def _rec709_decode(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    powered = ((encoded + (_ALPHA_709 - 1.0)) / _ALPHA_709) ** (1.0 / 0.45)
    return np.where(encoded < 4.5 * _BETA_709, encoded / 4.5, powered)


def _rec709_encode(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(linear < _BETA_709, 4.5 * linear, _ALPHA_709 * linear**0.45 - (_ALPHA_709 - 1.0))
