"""How much brighter one frame is than another, from the points that both show."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from relight.observations import sample_bilinear
from relight.raster import NEAR_M, project
from relight.stereo.frames import GreyFrames

_FEWEST = 40  # points whose median ratio is known to about a percent
_MOST = 2000
_LIMIT = 2.0
_DARKEST = 0.08  # grey value: below it a ratio is noise


def pair_gain(frames: GreyFrames, reference: int, source: int, points: NDArray[np.float64]) -> float:
    """Factor on the source's grey values that makes them the reference's: a median of ratios.

    1 where fewer than 40 points are in both pictures. A point that is hidden in one of them gives a wrong
    ratio; the median stands a third of these.
    """
    if len(points) < _FEWEST:
        return 1.0
    sample = torch.from_numpy(np.ascontiguousarray(points[:: max(1, len(points) // _MOST)], np.float32))
    values = []
    usable = torch.ones(len(sample), dtype=torch.bool)
    for index in (reference, source):
        camera = frames.cameras[index]
        uv_px, z = project(sample, camera)
        usable &= (z > NEAR_M) & (uv_px > 1).all(dim=1)
        usable &= (uv_px[:, 0] < camera.width - 1) & (uv_px[:, 1] < camera.height - 1)
        picture = frames.grey(index)
        place = uv_px.where(usable[:, None], torch.zeros_like(uv_px)).to(picture)
        values.append(sample_bilinear(picture[None], place)[:, 0].cpu())
    usable &= (values[0] > _DARKEST) & (values[1] > _DARKEST)
    usable &= (values[0] < 1.0) & (values[1] < 1.0)
    if int(usable.sum()) < _FEWEST:
        return 1.0
    gain = float((values[0][usable] / values[1][usable]).median())
    return float(np.clip(gain, 1.0 / _LIMIT, _LIMIT))
