"""The response on the page: the curve, how straight it makes exposures, and what others find."""

from __future__ import annotations

import numpy as np

from calib.plots import graph
from calib.report.page import figure, table
from calib.report.part import NO_EVIDENCE, UNKNOWN, Part, judged, sentences
from capture.json_fields import Fields
from capture.response import Response

SCHEMA = "relight-response-evidence"
NAME = "Response"
_GOOD = 0.02  # relative: what an albedo is off by


def response_part(response: Response | None, evidence: Fields | None) -> Part:
    """What is known of the response."""
    if response is None:
        return Part(NAME, UNKNOWN, "the transfer function of the frames is used")
    at = np.linspace(0.0, 1.0, 257)
    linear = response.to_linear(np.repeat(at[:, None], 3, axis=1)).astype(np.float64)
    curves = [(at, linear[:, channel], colour) for channel, colour in enumerate(("#c33", "#393", "#36c"))]
    named = response.transfer is not None
    caption = f"{response.source or 'Without source'}. Stored value above the dark level, and radiance."
    if evidence is None:
        body = f'<div class="grid">{figure(graph(curves, "response", ("stored", "radiance")), caption)}</div>'
        why = f"{response.transfer}, as it was named" if named else NO_EVIDENCE
        return judged(NAME, named, why, body, [])
    stored, sigma = evidence.array("stored", (None,)), np.array(evidence.values["sigma"], dtype=np.float64)
    line = np.array(evidence.values["linear"], dtype=np.float64)
    if line.ndim == 2:
        line, sigma = line[:, 1], sigma[:, 1]
    band = (stored, line - 20 * sigma, line + 20 * sigma)
    levels, deviations = evidence.array("levels", (None,)), evidence.array("deviations", (None,))
    largest = float(np.abs(deviations).max())
    checks = [
        (
            frame.text("name"),
            f"{1e3 * frame.number('claimed_s'):.3g} ms",
            "" if frame.number("off", None) is None else f"{100 * frame.number('off'):+.2f} %",
            f"± {100 * frame.number('sigma'):.2f} %",
            "used" if frame.values.get("used") else "left out",
        )
        for frame in evidence.children("frames", "frame")
    ]
    others = [
        (one.text("name"), f"{one.number('median'):.2%}", f"{one.number('largest'):.2%}")
        for one in evidence.children("others", "other")
    ]
    body = (
        '<div class="grid">'
        + figure(
            graph(curves, "response", ("stored", "radiance"), band),
            caption + " Shaded: twenty standard deviations.",
        )
        + figure(
            graph(
                [(levels, 100 * deviations, "var(--accent)"), (levels, 0 * levels, "var(--line)")],
                "linearity",
                ("stored", "percent"),
            ),
            "How far linearised values are from proportional to the exposure.",
        )
        + "</div>"
        + table(("exposure", "claimed", "off by", "", ""), checks)
        + (table(("against", "median", "largest"), others) if others else "")
    )
    why = f"linear to {largest:.2%} after it (good up to {_GOOD:.0%})"
    return judged(NAME, largest <= _GOOD, why, body, sentences(evidence, "warnings"))
