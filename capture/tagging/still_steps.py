"""How much brighter a still is than the ones before it, region by region, with its motion taken out.

The hand moves by degrees from still to still, and the mean light of a region changes by some percent for what
enters and leaves it. What stays in view keeps its light: diffuse reflection of the room does not change with
where one looks from. So each earlier picture is moved onto the later one by dense optical flow (Kroeger et
al. 2016) of locally normalised thumbnails, which no light changes much, and the median of the log ratio is
taken. That is a fifth of the noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Steps are taken to so many pictures before; further apart the hand has moved too far.
REACH = 3
#: Regions of a step: centre disc, ring around it, corners; then thirds of the rows in the middle columns.
LIGHT_REGIONS, THIRDS = slice(0, 3), slice(3, 6)
# Radii of the disc and of the corners, 1 = half the picture's sides.
_DISC, _CORNERS = 0.5, 1.0
_NEIGHBOURHOOD = 6.0  # cells of the thumbnail over which it is normalised
_LEAST_CONTRAST = 0.03  # log light; what is smoother than that is not blown up to noise


def light_steps(light: NDArray[np.float32]) -> tuple[Floats, ...]:
    """Log steps of light from each picture to the `REACH` after it.

    Args:
        light: [K, h, w] linear, positive.

    Returns:
        For each distance m from 1 on, [K - m, 6]: picture k + m over picture k, in each region.
    """
    count, rows, columns = light.shape
    regions = _regions(rows, columns)
    log = np.log(light).astype(np.float32)
    guides = [_normalised(picture) for picture in log]
    down, across = np.mgrid[0:rows, 0:columns].astype(np.float32)
    flow_of = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    steps = []
    for apart in range(1, REACH + 1):
        step = np.zeros((max(count - apart, 0), len(regions)))
        for k in range(len(step)):
            flow = flow_of.calc(guides[k + apart], guides[k], None)  # type: ignore[call-overload]
            moved = cv2.remap(
                log[k],
                across + flow[..., 0],
                down + flow[..., 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            ratio = log[k + apart] - moved
            step[k] = [np.median(ratio[region]) for region in regions]
        steps.append(step)
    return tuple(steps)


def disc_radiance(light: NDArray[np.float32]) -> Floats:
    """[K] mean linear light of the centre disc."""
    disc = _regions(*light.shape[1:])[0]
    return np.asarray(light[:, disc].mean(axis=1, dtype=np.float64))


def _regions(rows: int, columns: int) -> list[NDArray[np.bool_]]:
    y = ((np.arange(rows) + 0.5) / rows * 2 - 1)[:, None]
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :]
    radius = np.hypot(x, y)
    middle = np.abs(x) < 0.5
    thirds = [middle & (y >= low) & (y < low + 2 / 3) for low in (-1.0, -1 / 3, 1 / 3)]
    return [radius < _DISC, (radius >= _DISC) & (radius < _CORNERS), radius >= _CORNERS, *thirds]


def _normalised(log: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A picture in which neither level nor contrast of the light is left, only its pattern."""
    detail = log - cv2.GaussianBlur(log, (0, 0), _NEIGHBOURHOOD)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), _NEIGHBOURHOOD) + _LEAST_CONTRAST**2)
    return np.clip(128 + 50 * detail / contrast, 0, 255).astype(np.uint8)
