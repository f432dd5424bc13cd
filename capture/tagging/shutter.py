"""The rolling shutter's view of a light that goes on and off.

Row position r (0 = top edge of the picture, 1 = bottom edge) of a frame that starts at s is exposed during
[s + offset(r), s + offset(r) + e] with offset(r) = r ro for a readout ro >= 0 and (1 - r) |ro| for ro < 0
(bottom row first). Of a light that is on during [t_on, t_off] it gets the share

    a(r) = after(t_on) - after(t_off),    after(t) = clip((s + offset(r) + e - t) / e, 0, 1),

the part of the exposure after the one edge less the part after the other. `after` is piecewise linear in r,
so its mean over a band of rows is exact in closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def share_after(
    start_s: ArrayLike, edge_s: ArrayLike, readout_s: float, exposure_s: float, bands: int
) -> Floats:
    """Mean share of the exposure that comes after an edge, per band of rows.

    Args:
        start_s: [...] start of the frames' first exposed row.
        edge_s: [...] time of the edge, broadcast against `start_s`.
        readout_s: ro, negative when the bottom row is first.
        exposure_s: e, positive.
        bands: B, bands of equal height from the top edge to the bottom edge.

    Returns:
        [..., B] in 0..1.
    """
    border = np.linspace(0.0, 1.0, bands + 1)
    offset = border * readout_s + max(0.0, -readout_s)
    lead = np.asarray(start_s, float) - np.asarray(edge_s, float)
    # exposure after the edge, in exposures, at the bands' borders: below 0 none of it, above 1 all of it
    u = (lead[..., None] + offset + exposure_s) / exposure_s
    width = readout_s / bands / exposure_s
    if abs(width) < 1e-6:  # all rows at once: the mean is the value, and the quotient below would cancel
        return np.clip(u[..., :-1], 0.0, 1.0)
    # the mean of clip(u, 0, 1) over a band is the difference of its integral, u^2 / 2 up to 1 and u - 1/2
    # beyond
    inside = np.clip(u, 0.0, 1.0)
    u -= 1.0
    integral = np.maximum(u, 0.0, out=u)
    inside *= inside
    inside *= 0.5
    integral += inside
    return np.diff(integral, axis=-1) / width


def lit_share(
    start_s: ArrayLike, on_s: ArrayLike, off_s: ArrayLike, readout_s: float, exposure_s: float, bands: int
) -> Floats:
    """Mean lit share a of each band for one pulse; arguments as in `share_after`.

    Returns:
        [..., B] in 0..1, for on_s <= off_s.
    """
    return share_after(start_s, on_s, readout_s, exposure_s, bands) - share_after(
        start_s, off_s, readout_s, exposure_s, bands
    )


def sharp_limits(
    readout_s: float, exposure_s: float, full: float, none: float
) -> tuple[float, float, float, float]:
    """When a frame that starts at 0 is lit in full, or not at all, as limits on the pulse's edges.

    Args:
        readout_s: ro.
        exposure_s: e.
        full: least lit share of a lit frame's rows.
        none: greatest lit share of an unlit frame's rows.

    Returns:
        (on_full, off_full, off_none, on_none): lit when t_on <= on_full and t_off >= off_full; unlit when
        t_off <= off_none or t_on >= on_none. Exact for pulses longer than an exposure.
    """
    last_end = abs(readout_s) + exposure_s
    slack = (1.0 - full) * exposure_s
    return slack, last_end - slack, none * exposure_s, last_end - none * exposure_s
