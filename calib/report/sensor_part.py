"""Dark level, noise and flat field on the page."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration, Quantity
from calib.plots import graph
from calib.report.page import figure, table
from calib.report.part import UNKNOWN, Part, judged, sentences
from capture.json_fields import Fields

Floats = NDArray[np.float64]

_GOOD_DARK, _GOOD_SHOT = 0.004, 0.25  # one code of 8 bits; weights need no more
_GOOD_CORNER = 0.03  # of what the lens passes
_CHANNELS, _COLOURS = ("R", "G", "B"), ("#c33", "#393", "#36c")


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


def noise_part(calibration: Calibration, evidence: Fields | None) -> Part:
    """What is known of the noise."""
    read, shot = calibration.noise_read, calibration.noise_shot
    if read is None or shot is None:
        return Part("Noise", UNKNOWN, "weights follow the residuals")
    exposure = np.geomspace(1e-3, 1.0, 100)
    curves = []
    for channel, colour in enumerate(_COLOURS):
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
        + ("" if evidence is None else _transfer(read.value, shot.value, evidence))
        + "</div>"
    )
    relative = float((_spread(shot) / np.maximum(shot.value, 1e-12)).max())
    why = f"light's noise is known to {relative:.0%} (good up to {_GOOD_SHOT:.0%})"
    said = [] if evidence is None else sentences(evidence, "warnings")
    return judged("Noise", relative <= _GOOD_SHOT, why, body, said)


def _transfer(read: Floats, shot: Floats, evidence: Fields) -> str:
    """The variances of parts of pictures about the line, of green."""
    means, variances = (_numbers(evidence, key)[:, 1] for key in ("means", "variances"))
    seen = np.isfinite(variances)
    if not seen.any():
        return ""
    x = np.linspace(0.0, float(means[seen].max()), 50)
    drawn = graph(
        [(x, 1e6 * (read[1] ** 2 + shot[1] * x), "var(--ink)")],
        "photon transfer",
        ("exposure", "variance, millionths of white squared"),
        points=(means[seen], 1e6 * variances[seen]),
    )
    return figure(
        drawn,
        f"Variance of green in parts of {evidence.integer('pairs')} pairs, and the line of the model. Points "
        "off the line: the response is wrong, or the camera denoises.",
    )


def flat_part(calibration: Calibration, evidence: Fields | None) -> Part:
    """What is known of the lens's fall-off."""
    flat = calibration.flat_field
    if flat is None:
        return Part("Flat field", UNKNOWN, "vignetting is not corrected")
    r = np.linspace(0.0, 1.0, 60)
    powers = np.stack([r ** (2 * k) for k in range(1, len(flat.value) + 1)], axis=1)
    passed = 1.0 + powers @ flat.value
    count, said, flats = len(flat.value), [], ""
    # Terms go together: without their covariance the sum of their own variances is too large.
    covariance = np.diag(_spread(flat) ** 2)
    if evidence is not None:
        covariance, said = evidence.array("covariance", (count, count)), sentences(evidence, "warnings")
        rows = [
            (
                one.text("name"),
                f"{one.number('corner'):.3f}",
                f"{one.number('slope'):.1%}",
                f"{one.number('bowl'):.1%}",
                f"{one.number('texture'):.2%}",
            )
            for one in evidence.children("flats", "flat")
        ]
        flats = table(("picture", "corner", "light slopes by", "bowl of light", "texture"), rows)
    spread = np.sqrt(np.maximum(np.einsum("nk,kl,nl->n", powers, covariance, powers), 0.0))
    body = (
        '<div class="grid">'
        + figure(
            graph(
                [(r, passed, "var(--accent)")],
                "what the lens passes",
                ("distance from the centre, 1 = corner", "passed"),
                (r, passed - spread, passed + spread),
            ),
            f"{_said(flat)}. Shaded: one standard deviation"
            + ("." if evidence is not None else ", as if the terms were independent."),
        )
        + f"</div>{flats}"
    )
    why = f"the corner gets {passed[-1]:.3f} ± {spread[-1]:.3f} (good up to ± {_GOOD_CORNER:g})"
    good = bool(spread[-1] <= _GOOD_CORNER and passed.min() > 0.1 and passed.max() < 1.05)
    return judged("Flat field", good, why, body, said)


def _numbers(evidence: Fields, key: str) -> Floats:
    """[n, 3] of rows in which null stands for what did not count."""
    rows = evidence.values.get(key) or []
    try:
        values = np.array([[np.nan if v is None else v for v in row] for row in rows], dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise evidence.fail(f'"{key}" must be rows of three numbers.') from cause
    if values.ndim != 2 or values.shape[1] != 3:
        raise evidence.fail(f'"{key}" must be rows of three numbers.')
    return values


def _spread(quantity: Quantity) -> Floats:
    sigma = np.zeros(1) if quantity.sigma is None else quantity.sigma
    return np.broadcast_to(sigma, quantity.value.shape)


def _said(quantity: Quantity) -> str:
    return quantity.source or "Without source"
