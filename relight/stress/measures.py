"""Measures of pictures and files of portraits: nothing to measure, nothing but black, what no file holds."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from relight import metrics
from relight.errors import PortraitError
from relight.portrait import Portrait, load_portrait
from relight.stress.case import Case, Measured, Stage, at_most, epsilons
from relight.stress.subject import Floats, portrait

METRICS = Stage(
    "metrics",
    (torch.float64, torch.float32),
    "pictures are numpy's, which has no bf16; whatever they are, the sums are in float64",
)
FILES = Stage("portrait files")

_SIDE = 40
_ALL = np.ones((_SIDE, _SIDE), bool)
_FIRST_BITS = at_most(2.0**-24)
_ONLY = (torch.float32,)


def cases() -> Iterator[Case]:
    """All cases of this module."""
    yield from _known_measures()
    for exponent in (-6, 0, 6):
        pictures = partial(_pictures, 10.0**exponent)
        yield Case(METRICS, f"noise times 1e{exponent:+d}", pictures, epsilons(4))
    yield from _files()


def _known_measures() -> Iterator[Case]:
    """Measures whose value is known beforehand: the error is the difference."""
    for measure, pictures, truth in _KNOWN:
        name = f"{measure.__name__} of {' and '.join(pictures)}"
        says = "nothing measured" if math.isnan(truth) else f"{truth:g}"
        yield Case(METRICS, f"{name}: {says}", partial(_known, measure, pictures, truth), at_most(1e-6))


_PICTURES = {
    "grey": np.full((_SIDE, _SIDE, 3), 0.5),
    "black": np.zeros((_SIDE, _SIDE, 3)),
    "white": np.ones((_SIDE, _SIDE, 3)),
    "NaN": np.full((_SIDE, _SIDE, 3), np.nan),
    "a vector": np.array([[0.3, -0.4, 0.5]]),
    "its opposite": np.array([[-0.3, 0.4, -0.5]]),
    "zero": np.zeros((1, 3)),
    "no mask": np.zeros((_SIDE, _SIDE)),
    "a disc": (np.hypot(*(np.mgrid[0:_SIDE, 0:_SIDE] - 20.0)) < 12.0).astype(np.float64),
}


def psnr(picture: Floats, truth: Floats) -> float:
    """Over all pixels."""
    return metrics.psnr_db(picture, truth, _ALL)


def psnr_nowhere(picture: Floats, truth: Floats) -> float:
    """Over none."""
    return metrics.psnr_db(picture, truth, ~_ALL)


def ssim(picture: Floats, truth: Floats) -> float:
    """Over all pixels."""
    return metrics.ssim(picture, truth, _ALL)


def ssim_nowhere(picture: Floats, truth: Floats) -> float:
    """Over none."""
    return metrics.ssim(picture, truth, ~_ALL)


def scale(picture: Floats, truth: Floats) -> float:
    """Of the first channel."""
    return float(metrics.channel_scales(picture.reshape(-1, 3), truth.reshape(-1, 3))[0])


def angle(directions: Floats, truth: Floats) -> float:
    """Of the first direction."""
    return float(metrics.angles_deg(directions, truth)[0])


_Measure = Callable[[Floats, Floats], float]
_KNOWN: tuple[tuple[_Measure, tuple[str, str], float], ...] = (
    (psnr, ("grey", "grey"), math.inf),
    (psnr, ("black", "white"), 0.0),
    (psnr, ("NaN", "grey"), math.nan),
    (psnr_nowhere, ("grey", "grey"), math.nan),
    (ssim, ("grey", "grey"), 1.0),
    (ssim, ("black", "black"), 1.0),
    (ssim_nowhere, ("grey", "grey"), math.nan),
    (metrics.median_relative_error, ("grey", "black"), math.nan),
    (scale, ("black", "grey"), 1.0),
    (angle, ("a vector", "a vector"), 0.0),
    (angle, ("a vector", "its opposite"), 180.0),
    (angle, ("zero", "a vector"), 90.0),
    (angle, ("a vector", "zero"), math.nan),
    (metrics.mask_iou, ("no mask", "no mask"), math.nan),
    (metrics.mask_iou, ("no mask", "a disc"), 0.0),
    (metrics.alpha_error, ("a disc", "no mask"), math.nan),
    (metrics.silhouette_f_score, ("no mask", "no mask"), math.nan),
    (metrics.silhouette_f_score, ("no mask", "a disc"), 0.0),
    (metrics.silhouette_f_score, ("a disc", "a disc"), 1.0),
)


def _known(measure: _Measure, pictures: tuple[str, str], truth: float, dtype: torch.dtype) -> Measured:
    first, second = (_PICTURES[name].astype(_numpy_dtype(dtype)) for name in pictures)
    found = float(measure(first, second))
    same = (math.isnan(found) and math.isnan(truth)) or found == truth
    return Measured({}, error=0.0 if same else abs(found - truth))


def _numpy_dtype(dtype: torch.dtype) -> type[np.floating]:
    return np.float32 if dtype == torch.float32 else np.float64


def _pictures(gain: float, dtype: torch.dtype) -> Measured:
    random = np.random.default_rng(0)
    picture, truth = (gain * random.random((2, _SIDE, _SIDE, 3))).astype(_numpy_dtype(dtype))
    found = {measure.__name__: measure(picture, truth) for measure in (psnr, ssim, scale)}
    return Measured({name: torch.tensor(value, dtype=torch.float64) for name, value in found.items()})


def _files() -> Iterator[Case]:
    # A file holds float32: all of bf16, and of float64 the first 24 bits.
    yield Case(FILES, "written and read again", lambda dtype: _kept(portrait(dtype=dtype)), _FIRST_BITS)
    yield Case(FILES, "one point", lambda dtype: _kept(portrait(1, dtype)), _FIRST_BITS)
    for stressed, made in _WHOLE.items():
        yield Case(FILES, stressed, partial(_made_and_kept, made), at_most(0.0), dtypes=_ONLY)
    for stressed, made, refused in _REFUSED:
        yield Case(FILES, stressed, partial(_made_and_kept, made), refused=refused, dtypes=_ONLY)
    yield Case(FILES, "half a file", lambda _: _cut_short(), refused=PortraitError, dtypes=_ONLY)


def _with_albedo(value: float) -> Portrait:
    made = portrait()
    made.albedo[7, 1] = value
    return made


def _kept(made: Portrait) -> Measured:
    with tempfile.TemporaryDirectory() as folder:
        made.save(Path(folder))
        read = load_portrait(Path(folder))
    values = {name: value for name, value in vars(read).items() if isinstance(value, torch.Tensor)}
    worst = 0.0
    for name, value in values.items():
        written = getattr(made, name).double()
        scale = float(written.abs().max())
        worst = max(worst, float((value.double() - written).abs().max()) / (scale if scale > 0 else 1.0))
    return Measured(values, error=worst)


def _cut_short() -> Measured:
    with tempfile.TemporaryDirectory() as folder:
        portrait().save(Path(folder))
        file = Path(folder) / "portrait.safetensors"
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        return Measured({"points": load_portrait(Path(folder)).points})


def _made_and_kept(made: Callable[[], Portrait], dtype: torch.dtype) -> Measured:
    return _kept(made())


def _with_room(gain: float) -> Portrait:
    made = portrait()
    return replace(made, room_radiance=made.room_radiance * gain)


_WHOLE: dict[str, Callable[[], Portrait]] = {
    "radiance of 1e36": partial(_with_room, 1e37),
    "radiance of 1e-41, less than a normal number": partial(_with_room, 1e-40),
}

_REFUSED: tuple[tuple[str, Callable[[], Portrait], type[Exception]], ...] = (
    ("albedo of NaN", partial(_with_albedo, math.nan), PortraitError),
    ("albedo of Inf", partial(_with_albedo, math.inf), PortraitError),
    ("spacing of NaN", lambda: replace(portrait(), spacing=math.nan), ValueError),
    ("no point", lambda: portrait().subset(torch.zeros(3000, dtype=torch.bool)), PortraitError),
)
