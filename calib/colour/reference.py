"""The 24 patches of a ColorChecker Classic as linear sRGB and as CIELAB, and differences in the latter.

The reference values are those that colour-science has of charts from before and from after November 2014,
when X-Rite changed the pigments; they are for illuminant D50 and are brought to D65 by Bradford's transform.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PATCHES = 24
NEUTRAL = slice(18, 24)  # white to black, the last row
COLUMNS = 6
#: Editions of the chart: name -> colour-science's.
EDITIONS = {
    "after 2014": "ColorChecker24 - After November 2014",
    "before 2014": "ColorChecker24 - Before November 2014",
}
#: Where the patches lie, [24, 2] across and down, -1..1 over the chart's longer side.
PLACES = np.stack([np.arange(PATCHES) % COLUMNS - 2.5, np.arange(PATCHES) // COLUMNS - 1.5], axis=1) / 3.0

# IEC 61966-2-1, and the white that it is made for.
_XYZ_OF_SRGB = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], dtype=np.float64
)
_WHITE = _XYZ_OF_SRGB.sum(axis=1)
_LINEAR_BELOW = (6.0 / 29.0) ** 3


@dataclass(frozen=True, eq=False)
class Reference:
    """What the patches should be.

    Attributes:
        edition: a name of `EDITIONS`.
        names: [24] of the patches.
        srgb: [24, 3] linear, 1 = a perfect white.
    """

    edition: str
    names: tuple[str, ...]
    srgb: Floats

    @property
    def lab(self) -> Floats:
        """[24, 3] CIELAB."""
        return lab_of(self.srgb)


def load_reference(edition: str) -> Reference:
    """The patches of an edition of the chart."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colour-science says that it has no Matplotlib
        import colour

        chart = colour.CCS_COLOURCHECKERS[EDITIONS[edition]]
        xyz = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
        srgb = colour.XYZ_to_sRGB(
            xyz,
            illuminant=chart.illuminant,
            chromatic_adaptation_transform="Bradford",
            apply_cctf_encoding=False,
        )
    return Reference(edition, tuple(chart.data), np.asarray(srgb, dtype=np.float64))


def lab_of(srgb: Floats) -> Floats:
    """CIELAB [..., 3] (CIE 15:2004) of linear sRGB [..., 3], for its own white; L goes on below black."""
    ratio = srgb @ _XYZ_OF_SRGB.T / _WHITE
    root = np.cbrt(np.maximum(ratio, _LINEAR_BELOW))
    f = np.where(ratio > _LINEAR_BELOW, root, ratio * (29.0 / 6.0) ** 2 / 3.0 + 4.0 / 29.0)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def luminance(srgb: Floats) -> Floats:
    """Y [...] of linear sRGB [..., 3]."""
    return np.asarray(srgb @ _XYZ_OF_SRGB[1])


def delta_e(one: Floats, other: Floats) -> Floats:
    """Differences CIEDE2000 [...] of colours in CIELAB [..., 3] (Sharma, Wu and Dalal 2005)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from colour.difference import delta_E_CIE2000

        return np.asarray(delta_E_CIE2000(one, other), dtype=np.float64)
