"""From stored pixels to radiance: dark level, response, flat field, colour; each where it is known.

    exposure = response(stored - dark)                     linear, 1.0 = white clip
    radiance = colour (exposure / (1 + a1 r^2 + a2 r^4 + ...))

The exposure is what the sensor got: it tells clipping and noise. The radiance is what the scene sent.
Without any of the four, both are the transfer function of the session's pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.calibration_file import quantity_from_json
from capture.json_fields import Fields
from capture.response import Response, response_from_json

_LEAST_PASSED = 0.05  # of a lens that passes less, nothing is known


@dataclass(frozen=True, eq=False)
class Radiometry:
    """How the pictures of one camera become radiance.

    Attributes:
        response: stored value above the dark level -> exposure.
        dark: [3] stored value of a frame without light; None = 0.
        flat_field: [n] a1, a2, ... with r = distance from the picture's centre over half its diagonal;
            None = the lens passes everything.
        colour: [3, 3] linear camera RGB -> linear sRGB; None = they are the same.
    """

    response: Response
    dark: NDArray[np.float64] | None = None
    flat_field: NDArray[np.float64] | None = None
    colour: NDArray[np.float64] | None = None
    _kept: dict[Any, Any] = field(default_factory=dict, repr=False)  # tables and maps that come again

    @property
    def white(self) -> NDArray[np.float32]:
        """[3] exposure of the highest stored value: 1, or a little less where a dark level is taken off."""
        if self.dark is None:
            return np.ones(3, np.float32)
        return self.response.to_linear((1.0 - self.dark)[None])[0]

    def exposure(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """Linear exposure [H, W, 3] of a picture [H, W, 3] or [H, W]; float pictures are exposure already.

        Noise below the dark level stays negative: cut off, it would leave light where there is none.
        """
        if image.ndim == 2:
            image = np.repeat(image[..., None], 3, axis=2)
        if image.dtype == np.float32:
            return image
        if self.dark is None:
            return self.response.to_linear(image)
        table = self._table(image.dtype)
        planes = [np.take(table[:, channel], image[..., channel]) for channel in range(3)]
        return np.stack(planes, axis=2)

    def radiance(self, exposure: NDArray[np.float32]) -> NDArray[np.float32]:
        """Radiance [H, W, 3] of an exposure; the same array where lens and colour are not known."""
        if self.flat_field is not None:
            exposure = exposure / self.passed(exposure.shape[0], exposure.shape[1])[..., None]
        if self.colour is not None:
            exposure = exposure @ self.colour.T.astype(np.float32)
        return exposure

    def passed(self, height: int, width: int) -> NDArray[np.float32]:
        """[H, W] share of the light that the lens passes."""
        key = (height, width)
        if key not in self._kept:
            terms = np.zeros(0) if self.flat_field is None else self.flat_field
            y = (np.arange(height) + 0.5 - height / 2)[:, None]
            x = np.arange(width) + 0.5 - width / 2
            r2 = 4.0 * (x * x + y * y) / (width**2 + height**2)
            share = np.ones_like(r2)
            for power, term in enumerate(terms, start=1):
                share += term * r2**power
            self._kept[key] = np.maximum(share, _LEAST_PASSED).astype(np.float32)
        passed: NDArray[np.float32] = self._kept[key]
        return passed

    def _table(self, kind: np.dtype[Any]) -> NDArray[np.float32]:
        """[codes, 3] exposure of every stored code."""
        if kind not in self._kept:
            assert self.dark is not None
            codes = np.linspace(0.0, 1.0, np.iinfo(kind).max + 1)
            above = codes[:, None] - self.dark
            self._kept[kind] = np.copysign(self.response.to_linear(np.abs(above)), above).astype(np.float32)
        table: NDArray[np.float32] = self._kept[kind]
        return table


def radiometry_of(entries: Fields, transfer: str) -> Radiometry:
    """The radiometry of a calibration's entries.

    Args:
        entries: of a calibration.json, of which any may be missing.
        transfer: of the pictures, where no response is known.

    Raises:
        CalibrationError: an entry is malformed.
    """

    def known(name: str, shape: tuple[int | None, ...]) -> NDArray[np.float64] | None:
        entry = entries.child(name, None)
        return None if entry is None else quantity_from_json(entry, "1", shape).value

    response = entries.child("response", None)
    return Radiometry(
        Response(transfer) if response is None else response_from_json(response),
        known("dark", (3,)),
        known("flat_field", (None,)),
        known("colour", (3, 3)),
    )
