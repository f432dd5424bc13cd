"""The flash on the page: where it is, how it shines, and whether boards left out are predicted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Calibration
from calib.plots import bars, graph, svg
from calib.report.page import figure, table
from calib.report.part import NO_EVIDENCE, UNKNOWN, Part, judged, sentences
from capture.json_fields import Fields

Floats = NDArray[np.float64]

SCHEMA = "relight-flash-evidence"
NAME = "Flash"
_GOOD_M = 0.003  # at half a metre a third of a degree of light direction
_GOOD_RATIO = 1.5  # of what boards left out are off by over what was expected


def flash_part(calibration: Calibration, evidence: Fields | None) -> Part:
    """What is known of the flash."""
    offset = calibration.flash_offset_cam_m
    if offset is None:
        return Part(NAME, UNKNOWN, "the flash is taken to be at the lens, and as equal in all directions")
    sigma = None if offset.sigma is None else np.broadcast_to(offset.sigma, (3,))
    place = ", ".join(
        f"{name} {1e3 * value:.1f}" + ("" if sigma is None else f" ± {1e3 * sigma[k]:.1f}") + " mm"
        for k, (name, value) in enumerate(zip(("right", "down", "forwards"), offset.value, strict=True))
    )
    rows = [("place", place, offset.source)]
    if (axis := calibration.flash_axis) is not None:
        right, down = np.degrees(np.arctan2(axis.value[:2], axis.value[2]))
        rows.append(("axis", f"{right:.1f}° right, {down:.1f}° down", axis.source))
    if (falloff := calibration.flash_falloff) is not None:
        spread = "" if falloff.sigma is None else f" ± {float(falloff.sigma.item()):.2f}"
        rows.append(("falloff", f"cos^{float(falloff.value.item()):.2f}{spread}", falloff.source))
    if (strength := calibration.flash_strength) is not None:
        rows.append(
            ("strength", ", ".join(f"{value:.4g}" for value in strength.value) + " m²", strength.source)
        )
    body = table(("", "value", "from"), rows)
    if evidence is None:
        known = sigma is not None and float(sigma.max()) <= _GOOD_M
        return judged(NAME, known, NO_EVIDENCE, body, [])
    held_out = evidence.child("held_out")
    rms, expected = held_out.number("rms"), held_out.number("expected")
    pulses = list(evidence.children("pulses", "pulse"))
    names = [pulse.text("name") for pulse in pulses]
    gains = np.array([pulse.number("gain") for pulse in pulses])
    covariance = evidence.array("covariance", (8, 8))
    body += (
        '<div class="grid">'
        + figure(
            _front(offset.value, covariance),
            "The camera from behind, mm: the lens (ring), the flash, and its 95 % region.",
        )
        + figure(
            bars(np.abs(100 * gains).tolist(), names, "pulses"),
            "How much each pulse differs from the trend, percent.",
        )
        + figure(
            bars([100 * abs(pulse.number("held_out")) for pulse in pulses], names, "boards left out"),
            f"How far boards left out are from what the others predict, percent: {100 * rms:.2f} in all, "
            f"{100 * expected:.2f} expected.",
        )
        + _beam(calibration)
        + "</div>"
    )
    worst = 0.0 if sigma is None else float(sigma.max())
    good = worst <= _GOOD_M and rms <= _GOOD_RATIO * expected
    why = (
        f"its place is known to {1e3 * worst:.1f} mm (good up to {1e3 * _GOOD_M:g}), boards left out are off "
        f"by {100 * rms:.2f} % where {100 * expected:.2f} % are expected"
    )
    return judged(NAME, good, why, body, sentences(evidence, "notes"))


def _beam(calibration: Calibration) -> str:
    if calibration.flash_falloff is None:
        return ""
    falloff = float(calibration.flash_falloff.value.item())
    angle = np.linspace(-40.0, 40.0, 81)
    light = np.cos(np.radians(angle)) ** falloff
    return figure(
        graph([(angle, light, "var(--accent)")], "beam", ("degrees from its axis", "light")),
        "What the flash sends beside its axis.",
    )


def _front(place_m: Floats, covariance: Floats) -> str:
    """The lens in the middle and the flash beside it, in camera axes."""
    reach = 1.3e3 * max(float(np.abs(place_m[:2]).max()), 0.01)
    scale = 150.0 / reach
    x, y = 200 + scale * 1e3 * place_m[0], 160 + scale * 1e3 * place_m[1]
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    turn = np.linspace(0, 2 * np.pi, 49)
    # 5.99: 95 % of a chi-square with two degrees of freedom.
    ring = vectors @ (
        np.sqrt(5.99 * np.maximum(values, 0.0))[:, None] * np.stack([np.cos(turn), np.sin(turn)])
    )
    points = " ".join(
        f"{x + scale * 1e3 * a:.1f},{y + scale * 1e3 * b:.1f}" for a, b in zip(*ring, strict=True)
    )
    small = 'font-size="12" fill="var(--quiet)"'
    said = f"{1e3 * place_m[0]:.1f}, {1e3 * place_m[1]:.1f}"
    parts = [
        '<circle cx="200" cy="160" r="12" fill="none" stroke="var(--ink)" stroke-width="3"/>',
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="var(--accent)"/>',
        f'<polygon points="{points}" fill="var(--accent)" fill-opacity="0.3"/>',
        f'<text x="{x + 8:.0f}" y="{y - 8:.0f}" {small}>{said}</text>',
        f'<text x="6" y="312" {small}>right and down are the camera\'s own</text>',
    ]
    return svg(400, 320, parts, "place of the flash")
