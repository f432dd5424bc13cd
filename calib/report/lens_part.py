"""The lens on the page: how far a projected pixel is off, what residuals say, whether the halves agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.calibration import Intrinsics
from calib.plots import arrows, heat_map
from calib.report.page import figure, table
from calib.report.part import NO_EVIDENCE, UNKNOWN, Part, judged, sentences
from capture.json_fields import Fields

Floats = NDArray[np.float64]

SCHEMA = "relight-intrinsics-evidence"
NAME = "Lens"
_GOOD_PX = 0.3  # a third of a pixel is below what poses of a head are known to


def lens_part(intrinsics: Intrinsics | None, evidence: Fields | None) -> Part:
    """What is known of the lens."""
    if intrinsics is None:
        return Part(NAME, UNKNOWN, "the lens is taken from the poses, from Exif data, or guessed")
    names = ["fx", "fy", "cx", "cy"]
    pinhole = intrinsics.pinhole
    rows = _rows(names, pinhole.value, pinhole.sigma, "px")
    if intrinsics.distortion is not None:
        terms = intrinsics.distortion
        names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
        rows += _rows(names[: len(terms.value)], terms.value, terms.sigma, "")
    body = table(("", "value", "one standard deviation"), rows)
    body += f"<p class=quiet>Pictures of {intrinsics.width} × {intrinsics.height} pixels.</p>"
    if evidence is None:
        return judged(NAME, False, NO_EVIDENCE, body, [])
    projection = evidence.child("projection")
    columns = projection.integer("columns", low=1)
    sigma = np.array(
        [np.nan if v is None else v for v in projection.values.get("sigma_px", [])], dtype=np.float64
    )
    size = (intrinsics.width, intrinsics.height)
    distance_m = projection.number("distance_m")
    views = list(evidence.children("views", "view"))
    found = np.concatenate([view.array("found_px", (None, 2)) for view in views])
    residuals = np.concatenate([view.array("residuals_px", (None, 2)) for view in views])
    drawn, larger = arrows(found, residuals, size, "residuals in the picture")
    worst, middle = float(np.nanmax(sigma)), float(np.nanmedian(sigma))
    halves = list(evidence.children("halves", "half"))
    agree = all(half.number("chance") > 0.01 for half in halves)
    body += (
        '<div class="grid">'
        + figure(
            heat_map(sigma, columns, size, None, "projection uncertainty", "px"),
            "How far a projected pixel may be off: one standard deviation in the worst direction, px, at "
            f"{distance_m:.2f} m.",
        )
        + figure(
            drawn,
            f"Corners found minus projected, {larger:g} times as long, of {len(views)} pictures. Neighbours "
            "that point the same way are an error of the model; a mess is noise.",
        )
        + "</div>"
        + table(
            ("halves of the pictures", "apart", "expected", "chance"),
            [
                (
                    half.text("split"),
                    f"{half.number('rms_px'):.3f} px",
                    f"{half.number('expected_px'):.3f} px",
                    f"{half.number('chance'):.0%}",
                )
                for half in halves
            ],
        )
    )
    why = f"a pixel is projected to {middle:.2f} px (good up to {_GOOD_PX:g}), {worst:.2f} px at worst" + (
        "" if agree else "; two halves of the pictures do not agree"
    )
    return judged(NAME, middle <= _GOOD_PX and agree, why, body, sentences(evidence, "warnings"))


def _rows(
    names: Sequence[str], values: Floats, sigma: Floats | None, unit: str
) -> list[tuple[str, str, str]]:
    spread = [None] * len(values) if sigma is None else np.broadcast_to(sigma, values.shape).tolist()
    return [
        (name, f"{value:.5g} {unit}", "not known" if one is None else f"± {one:.3g} {unit}")
        for name, value, one in zip(names, values.tolist(), spread, strict=True)
    ]
