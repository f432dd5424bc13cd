"""calibration.json: what is known of one camera and its flash.

Every entry is optional, carries unit, uncertainty and provenance (`Quantity`), and has a stated fallback, so
that a session without any calibration can be fitted and says what it assumed. The entries, with shapes and
units:

    intrinsics           width, height; pinhole [4] fx, fy, cx, cy in px (centres at 0.5);
                         distortion [n] in OpenCV's order k1, k2, p1, p2, k3, ...
    response             named curve or table, stored value -> radiance (`capture.response`)
    dark                 [3] stored value (0..1) of a frame without light; taken off before the response
    noise_read           [3] standard deviation of radiance at black
    noise_shot           [3] var = noise_read^2 + noise_shot * radiance
    flat_field           [n] a1, a2, ...: the lens passes 1 + a1 r^2 + a2 r^4 + ..., with r = distance from
                         the picture's centre over half its diagonal; radiance is divided by it
    colour               [3, 3] linear camera RGB -> linear sRGB (primaries of IEC 61966-2-1), in which white
                         under the flash is grey; radiance is multiplied by it
    room_white           [3] white under the room's light in the sRGB of `colour`, its mean 1: the colour of
                         the room's light for one that takes the flash for white
    flash_offset_cam_m   [3] position of the flash in camera axes, m
    flash_axis           [3] unit direction in which the flash is strongest, camera axes
    flash_falloff        mu >= 0: the flash sends cos(angle to its axis)^mu, the model of an LED (Quéau et al.
                         2018); 0 = the same in every direction
    flash_strength       [3] C_flash: radiance of a white Lambertian surface that faces the flash at 1 m, m^2,
                         in camera RGB
    readout_s            of a rolling shutter, for tagging: from the first row's start to the last row's, s,
                         negative when the bottom row is first

An entry may say which settings of the camera it holds for ("made_with"); `session_calibration` leaves out
those that do not hold for a session.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.calibration_file import (
    Quantity,
    quantity_from_json,
    read_calibration_entries,
    write_calibration_entries,
)
from capture.cameras import LARGEST_SIDE
from capture.errors import CalibrationError
from capture.json_fields import Fields
from capture.response import Response, response_from_json
from capture.session import Session

__all__ = [
    "Calibration",
    "Intrinsics",
    "Quantity",
    "load_calibration",
    "save_calibration",
    "session_calibration",
]


@dataclass(frozen=True)
class _Kind:
    """Unit and shape of a quantity, its lower bound, and what is assumed without it."""

    unit: str
    shape: tuple[int | None, ...]
    low: float | None
    fallback: tuple[float, ...] | None
    assumption: str


_KINDS = {
    "dark": _Kind("1", (3,), 0.0, (0.0, 0.0, 0.0), "No dark level is known; black is taken as 0."),
    "noise_read": _Kind("1", (3,), 0.0, None, "No noise model is known; weights follow the residuals."),
    "noise_shot": _Kind("1", (3,), 0.0, None, "No noise model is known; weights follow the residuals."),
    "flat_field": _Kind("1", (None,), None, (), "No flat field is known; vignetting is not corrected."),
    "colour": _Kind(
        "1",
        (3, 3),
        None,
        (1, 0, 0, 0, 1, 0, 0, 0, 1),
        "No colour matrix is known; camera RGB is taken as sRGB.",
    ),
    "room_white": _Kind("1", (3,), 0.0, None, "No colour of the room's light is known; the fit finds it."),
    "flash_offset_cam_m": _Kind(
        "m", (3,), None, (0.0, 0.0, 0.0), "No flash position is known; it is taken to be at the lens."
    ),
    "flash_axis": _Kind(
        "1", (3,), None, (0.0, 0.0, 1.0), "No flash direction is known; it is taken along the optical axis."
    ),
    "flash_falloff": _Kind(
        "1", (), 0.0, (0.0,), "No flash falloff is known; the flash is taken as equal in all directions."
    ),
    "flash_strength": _Kind("m^2", (3,), 0.0, None, "No flash strength is known; the fit finds it."),
    "readout_s": _Kind("s", (), None, None, "No readout is known; each tagging of the flash finds it."),
}
_NO_INTRINSICS = "No intrinsics are known; those of the poses are used."
_NO_RESPONSE = "No response is known; the transfer function of the frames is used."


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera's geometry at one picture size.

    Attributes:
        width: pixels.
        height: pixels.
        pinhole: [4] fx, fy, cx, cy in px.
        distortion: [n] in OpenCV's order, dimensionless; None = none.
    """

    width: int
    height: int
    pinhole: Quantity
    distortion: Quantity | None = None

    @property
    def K(self) -> NDArray[np.float64]:
        """[3, 3] intrinsic matrix in pixels."""
        fx, fy, cx, cy = self.pinhole.value
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known of one camera and its flash; the module says what each entry means. None = not known."""

    intrinsics: Intrinsics | None = None
    response: Response | None = None
    dark: Quantity | None = None
    noise_read: Quantity | None = None
    noise_shot: Quantity | None = None
    flat_field: Quantity | None = None
    colour: Quantity | None = None
    room_white: Quantity | None = None
    flash_offset_cam_m: Quantity | None = None
    flash_axis: Quantity | None = None
    flash_falloff: Quantity | None = None
    flash_strength: Quantity | None = None
    readout_s: Quantity | None = None

    def value(self, name: str) -> NDArray[np.float64] | None:
        """The value of a quantity by its name, or its fallback; None where only the fit can tell."""
        quantity: Quantity | None = getattr(self, name)
        if quantity is not None:
            return quantity.value
        kind = _KINDS[name]
        if kind.fallback is None:
            return None
        return np.array(kind.fallback, dtype=np.float64).reshape(
            [n if n is not None else -1 for n in kind.shape]
        )

    def assumptions(self) -> list[str]:
        """One sentence for each thing that is assumed because it was not calibrated."""
        sentences = [kind.assumption for name, kind in _KINDS.items() if getattr(self, name) is None]
        if self.response is None:
            sentences.insert(0, _NO_RESPONSE)
        if self.intrinsics is None:
            sentences.insert(0, _NO_INTRINSICS)
        return list(dict.fromkeys(sentences))


def load_calibration(path: Path) -> Calibration:
    """Reads a calibration.json; a file that does not exist is a calibration in which nothing is known.

    Raises:
        CalibrationError: malformed, of another unit or shape than said above, or physically impossible.
    """
    if not path.is_file():
        return Calibration()
    return _calibration_of(read_calibration_entries(path))


def session_calibration(session: Session) -> Calibration:
    """What of a session's calibration holds for its frames: those entries that were made with its settings.

    Raises:
        CalibrationError: as `load_calibration`.
    """
    entries, _ = session.read_calibration()
    return _calibration_of(entries)


def _calibration_of(entries: Fields) -> Calibration:
    known = {field.name for field in fields(Calibration)}
    if unknown := sorted(entries.values.keys() - known - {"schema", "version"}):
        raise entries.fail(f"the entry {unknown[0]!r} is unknown (known: {', '.join(sorted(known))}).")
    quantities: dict[str, Any] = {
        name: _quantity(entries.child(name), kind) for name, kind in _KINDS.items() if name in entries
    }
    return Calibration(
        intrinsics=_intrinsics(entries.child("intrinsics", None)),
        response=response_from_json(entries.child("response")) if "response" in entries else None,
        **quantities,
    )


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Writes what is known to a calibration.json; other entries of the file stay as they are.

    Raises:
        CalibrationError: the file is there but malformed; or a value is not possible.
    """
    content: dict[str, Any] = {}
    for name, kind in _KINDS.items():
        quantity: Quantity | None = getattr(calibration, name)
        if quantity is not None:
            content[name] = quantity.to_json()
            _quantity(Fields(content[name], f"{path}: {name}", CalibrationError), kind)
    if calibration.response is not None:
        content["response"] = calibration.response.to_json()
    if calibration.intrinsics is not None:
        known = calibration.intrinsics
        content["intrinsics"] = {
            "width": known.width,
            "height": known.height,
            "pinhole": known.pinhole.to_json(),
            "distortion": None if known.distortion is None else known.distortion.to_json(),
        }
        _intrinsics(Fields(content["intrinsics"], f"{path}: intrinsics", CalibrationError))
    write_calibration_entries(path, content)


def _quantity(entry: Fields, kind: _Kind) -> Quantity:
    quantity = quantity_from_json(entry, kind.unit, kind.shape)
    if kind.low is not None and (smallest := quantity.value.min()) < kind.low:
        raise entry.fail(f"{smallest:g} is below the limit {kind.low:g}.")
    if kind is _KINDS["flash_axis"] and abs(float(np.linalg.norm(quantity.value)) - 1.0) > 1e-6:
        raise entry.fail("the direction must be a unit vector.")
    return quantity


def _intrinsics(entry: Fields | None) -> Intrinsics | None:
    if entry is None:
        return None
    pinhole = quantity_from_json(entry.child("pinhole"), "px", (4,))
    if not (pinhole.value[:2] > 0).all():
        raise entry.fail("the focal lengths must be positive.")
    distortion = entry.child("distortion", None)
    return Intrinsics(
        width=entry.integer("width", low=1, high=LARGEST_SIDE),
        height=entry.integer("height", low=1, high=LARGEST_SIDE),
        pinhole=pinhole,
        distortion=None if distortion is None else quantity_from_json(distortion, "1", (None,)),
    )
