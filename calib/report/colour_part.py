"""Colours on the page: every patch as it should be and as it comes out, and how far apart these are."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration
from calib.plots import bars, svg
from calib.report.page import figure, table
from calib.report.part import NO_EVIDENCE, UNKNOWN, Part, judged, sentences
from capture.json_fields import Fields
from capture.transfer import to_display

Floats = NDArray[np.float64]

SCHEMA = "relight-colour-evidence"
NAME = "Colour"
_GOOD = 3.0  # mean CIEDE2000 of patches left out; 1 is just seen, cameras reach 1.5 to 2.5


def colour_part(calibration: Calibration, evidence: Fields | None) -> Part:
    """What is known of colours."""
    colour = calibration.colour
    if colour is None:
        return Part(NAME, UNKNOWN, "camera RGB is taken as sRGB")
    sigma = np.zeros((3, 3)) if colour.sigma is None else np.broadcast_to(colour.sigma, (3, 3))
    rows = [
        (name, *(f"{value:+.4f} ± {one:.4f}" for value, one in zip(line, spread, strict=True)))
        for name, line, spread in zip(("sRGB R", "sRGB G", "sRGB B"), colour.value, sigma, strict=True)
    ]
    body = table(("", "camera R", "camera G", "camera B"), rows)
    if calibration.room_white is not None:
        white = ", ".join(f"{value:.3f}" for value in calibration.room_white.value)
        body += f"<p>White in the room's light is {white} (R, G, B), taking the flash for white.</p>"
    if evidence is None:
        return judged(NAME, False, NO_EVIDENCE, body, [])
    words, said, means = [], [], []
    for light in ("flash", "room"):
        one = evidence.child(light, None)
        if one is None:
            continue
        drawn, mean, rows = _light(light, one)
        body += drawn + table(("CIEDE2000", "mean", "95 %", "largest", "mean of patches left out"), rows)
        means.append(mean)
        words.append(f"{mean:.2f} under the {light}")
        said += sentences(one, "warnings")
    why = f"patches left out are off by {' and '.join(words)} CIEDE2000 (good up to {_GOOD:g})"
    return judged(NAME, bool(means) and max(means) <= _GOOD, why, body, said)


def _light(light: str, one: Fields) -> tuple[str, float, list[tuple[str, ...]]]:
    names = sentences(one, "names")
    reference, corrected = one.array("reference", (24, 3)), one.array("corrected", (24, 3))
    errors = one.child("delta_e")
    fitted = errors.array("matrix", (24,))
    left_out = errors.array("matrix_left_out", (24,))
    drawn = (
        '<div class="grid">'
        + figure(
            _swatches(reference, corrected, names),
            f"ColorChecker {one.text('edition')} under the {light}: around, what a patch should be; in its "
            "middle, what it comes out as.",
        )
        + figure(bars(fitted.tolist(), names, "difference by patch"), "CIEDE2000 by patch.")
        + "</div>"
    )
    rows = [_errors("matrix", fitted, left_out)]
    uncorrected = errors.array("uncorrected", (24,))
    rows.append(_errors("white alone", uncorrected, None))
    rows.append(
        _errors(
            "root-polynomial (not applied)",
            errors.array("root_polynomial", (24,)),
            errors.array("root_polynomial_left_out", (24,)),
        )
    )
    return drawn, float(left_out.mean()), rows


def _errors(name: str, fitted: Floats, left_out: Floats | None) -> tuple[str, ...]:
    return (
        name,
        f"{fitted.mean():.2f}",
        f"{np.percentile(fitted, 95):.2f}",
        f"{fitted.max():.2f}",
        "" if left_out is None else f"{left_out.mean():.2f}",
    )


def _swatches(reference: Floats, corrected: Floats, names: list[str]) -> str:
    parts = ['<rect width="640" height="428" fill="#111"/>']
    for number, (wanted, got, name) in enumerate(zip(reference, corrected, names, strict=True)):
        row, column = divmod(number, 6)
        x, y = 6 + 106 * column, 4 + 106 * row
        parts.append(
            f'<g><title>{escape(name)}</title><rect x="{x}" y="{y}" width="100" height="100" '
            f'fill="{_hex(wanted)}"/><rect x="{x + 25}" y="{y + 25}" width="50" height="50" '
            f'fill="{_hex(got)}"/></g>'
        )
    return svg(640, 428, parts, "patches")


def _hex(linear: Floats) -> str:
    codes = np.rint(255 * to_display(np.clip(linear, 0.0, 1.0))).astype(int)
    return "#" + "".join(f"{code:02x}" for code in codes)
