"""Dark level, noise and flat field on the page."""

from __future__ import annotations

from html import escape

import numpy as np

from calib.calibration import Calibration, Quantity
from calib.plots import graph
from calib.report.page import figure, table
from calib.report.part import UNKNOWN, Part, judged

_GOOD_DARK, _GOOD_CORNER = 0.004, 0.03  # one code of 8 bits; what is left in the corners, relative
_CHANNELS = ("R", "G", "B")


def dark_part(calibration: Calibration) -> Part:
    """What is known of the dark level."""
    dark = calibration.dark
    if dark is None:
        return Part("Dark level", UNKNOWN, "black is taken as 0")
    sigma = _spread(dark)
    rows = [
        (name, f"{255 * value:.2f} of 255", f"± {255 * one:.2f}")
        for name, value, one in zip(_CHANNELS, dark.value, sigma, strict=True)
    ]
    why = f"known to {255 * sigma.max():.2f} of 255 (good up to {255 * _GOOD_DARK:.0f})"
    body = table(("", "level", "one standard deviation"), rows) + f"<p class=quiet>{escape(_said(dark))}</p>"
    return judged("Dark level", bool(sigma.max() <= _GOOD_DARK), why, body, [])


def noise_part(calibration: Calibration) -> Part:
    """What is known of the noise."""
    read, shot = calibration.noise_read, calibration.noise_shot
    if read is None or shot is None:
        return Part("Noise", UNKNOWN, "weights follow the residuals")
    exposure = np.geomspace(1e-3, 1.0, 100)
    curves = []
    for channel, colour in enumerate(("#c33", "#393", "#36c")):
        sigma = np.sqrt(read.value[channel] ** 2 + shot.value[channel] * exposure)
        curves.append((np.log10(exposure), 20 * np.log10(exposure / np.maximum(sigma, 1e-12)), colour))
    well = [f"{1 / value:.0f}" if value > 0 else "not found" for value in shot.value]
    rows = [
        (name, f"{1e3 * dark:.3f} ± {1e3 * dark_sigma:.3f} ‰", f"{electrons} electrons")
        for name, dark, dark_sigma, electrons in zip(_CHANNELS, read.value, _spread(read), well, strict=True)
    ]
    body = (
        table(("", "noise at black, of white", "white is"), rows)
        + '<div class="grid">'
        + figure(
            graph(curves, "signal to noise", ("exposure, powers of ten of white", "dB")),
            f"Signal over noise. {_said(read)}.",
        )
        + "</div>"
    )
    relative = float((_spread(shot) / np.maximum(shot.value, 1e-12)).max())
    why = f"light's noise is known to {relative:.0%} (good up to 25 %)"
    return judged("Noise", relative <= 0.25, why, body, [])


def flat_part(calibration: Calibration) -> Part:
    """What is known of the lens's fall-off."""
    flat = calibration.flat_field
    if flat is None:
        return Part("Flat field", UNKNOWN, "vignetting is not corrected")
    r = np.linspace(0.0, 1.0, 60)
    powers = np.stack([r ** (2 * k) for k in range(1, len(flat.value) + 1)], axis=1)
    passed = 1.0 + powers @ flat.value
    # The first term carries what is unsure of all: the terms go together, and their own sigmas tell less.
    spread = powers[:, 0] * float(_spread(flat)[0])
    body = (
        '<div class="grid">'
        + figure(
            graph(
                [(r, passed, "var(--accent)")],
                "what the lens passes",
                ("distance from the centre, 1 = corner", "passed"),
                (r, passed - spread, passed + spread),
            ),
            f"{_said(flat)}. Shaded: one standard deviation.",
        )
        + "</div>"
    )
    why = f"the corner gets {passed[-1]:.3f} (see what is shaded for how sure that is)"
    sane = bool(passed.min() > 0.1 and passed.max() < 1.05)
    return judged("Flat field", sane, why, body, [])


def _spread(quantity: Quantity) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    sigma = np.zeros(1) if quantity.sigma is None else quantity.sigma
    return np.broadcast_to(sigma, quantity.value.shape)


def _said(quantity: Quantity) -> str:
    return quantity.source or "Without source"
