"""What `relight.evaluate` measured, as rows for a person: in a terminal, in a report, in a document."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from relight.metrics import BAND_PX, TOLERANCE_PX

Row = tuple[str, str, str]
"""Name of the measure, value with its unit, note."""


def measure_rows(result: Mapping[str, Any]) -> list[Row]:
    """The measures of a result, those that it has, in the order in which they are usually told."""
    return [
        *_captured(result),
        *_albedo(result),
        *_normals(result),
        *_lights(result),
        *_mask(result),
        *_poses(result),
        *_time(result),
    ]


def format_table(result: Mapping[str, Any]) -> str:
    """A result as plain text: a title, one line a measure, and what is missing."""
    rows = measure_rows(result)
    widths = [max((len(row[column]) for row in rows), default=0) for column in (0, 1)]
    who = " ".join(str(result[key]) for key in ("session", "portrait") if key in result) or "a portrait"
    lines = [
        f"{who}, measured against {result.get('truth', 'the truth')} in {result.get('views', 0)} views",
        "",
    ]
    lines += [f"{name:<{widths[0]}}  {value:>{widths[1]}}  {note}".rstrip() for name, value, note in rows]
    if result.get("missing"):
        lines += ["", *result["missing"]]
    return "\n".join(lines)


def format_markdown(result: Mapping[str, Any]) -> str:
    """A result as a table for a document."""
    lines = ["| measure | value | |", "| --- | ---: | --- |"]
    return "\n".join(
        [*lines, *(f"| {name} | {value} | {note} |" for name, value, note in measure_rows(result))]
    )


def _captured(result: Mapping[str, Any]) -> Iterator[Row]:
    if measures := result.get("captured"):
        known = {
            name: view["psnr_db"] for name, view in measures["by_view"].items() if view["psnr_db"] is not None
        }
        worst = min(known, key=lambda name: known[name], default=None)
        note = _views(measures) + (f", worst {_db(known[worst])} ({worst})" if worst is not None else "")
        yield "captured view, PSNR", _db(measures["psnr_db"]), note
        yield "captured view, SSIM", _number(measures["ssim"], ".4f"), ""


def _albedo(result: Mapping[str, Any]) -> Iterator[Row]:
    if measures := result.get("albedo"):
        yield (
            "albedo, PSNR",
            _db(measures["psnr_db"]),
            f"{_views(measures)}, scales {_scales(measures['scales'])}",
        )
        yield "albedo, median relative error", _number(measures["median_relative_error"], ".1%"), ""


def _normals(result: Mapping[str, Any]) -> Iterator[Row]:
    if measures := result.get("normals"):
        yield "normals, mean angle", _number(measures["mean_deg"], ".2f", "°"), _views(measures)
        yield "normals, median angle", _number(measures["median_deg"], ".2f", "°"), ""
        yield "normals within 10°", _number(measures["within_10_deg"], ".1%"), ""


def _lights(result: Mapping[str, Any]) -> Iterator[Row]:
    for name, measures in result.get("lights", {}).items():
        note = f"{_views(measures)}, scales {_scales(measures['scales'])}"
        yield f"light {name}, PSNR", _db(measures["psnr_db"]), note


def _mask(result: Mapping[str, Any]) -> Iterator[Row]:
    if measures := result.get("mask"):
        yield "mask, IoU at 0.5", _number(measures["iou"], ".4f"), _views(measures)
        yield (
            "mask, error near the silhouette",
            _number(measures["alpha_error"], ".3f"),
            f"mean, within {BAND_PX:g} px",
        )
        yield (
            "mask, F-score of the outline",
            _number(measures["silhouette_f"], ".3f"),
            f"within {TOLERANCE_PX:g} px",
        )


def _poses(result: Mapping[str, Any]) -> Iterator[Row]:
    if errors := result.get("alignment"):
        share = errors["centre_median_share"]
        note = f"median of {errors['cameras']:.0f} cameras, worst {errors['rotation_worst_deg']:.3f}°"
        yield "poses, rotation error", _number(errors["rotation_median_deg"], ".3f", "°"), note
        yield (
            "poses, error of the centre",
            _number(1000.0 * errors["centre_median"], ".2f", " mm"),
            f"{share:.2%} of the distance, worst {1000.0 * errors['centre_worst']:.2f} mm",
        )
        yield "unit of length, true metres", _number(errors["scale"], ".3f"), "1 = right"


def _time(result: Mapping[str, Any]) -> Iterator[Row]:
    if fit := result.get("fit"):
        memory = fit.get("peak_memory_mb")
        stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in fit.get("seconds", {}).items())
        yield "time of the fit", _number(fit.get("total_s"), ".1f", " s"), stages
        yield "peak memory of the fit", _number(memory, ",.0f", " MB"), str(fit.get("device", ""))
    if time := result.get("time"):
        note = f"maps and lights; the first one {time['first_view_s']:.2f} s"
        yield "time of a view", _number(time["view_s"], ".2f", " s"), note


def _views(measures: Mapping[str, Any]) -> str:
    return f"{measures['views']} view" + ("s" if measures["views"] != 1 else "")


def _scales(scales: Sequence[float | None]) -> str:
    return " ".join(_number(scale, ".3f") for scale in scales)


def _db(value: float | None) -> str:
    return _number(value, ".2f", " dB")


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "–" if value is None else f"{value:{form}}{unit}"
