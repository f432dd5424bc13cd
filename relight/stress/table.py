"""Verdicts as text for a person, and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import torch

from relight.stress.case import DTYPES, Case, Outcome, Verdict, dtype_name
from relight.stress.suite import stages

_NAME = 66  # columns
_COLUMNS = tuple(dtype_name(dtype) for dtype in DTYPES)
_SEVERITY = (Outcome.FAILED, Outcome.NOT_RUN, Outcome.REFUSED, Outcome.FINITE)


def header() -> str:
    """The line above the table."""
    return f"{'case':<{_NAME}}  {'outcome':<15}  " + "".join(f"{name:>9}" for name in _COLUMNS) + "  gradient"


def row(verdicts: Sequence[Verdict]) -> str:
    """A case's verdicts in one line: worst outcome, error in each precision, gradients; below, what failed.

    An error is relative to the largest value of the reference; a dash stands where nothing is compared, a
    blank where the stage is not used in that precision.
    """
    errors = {verdict.dtype: _number(verdict.error) for verdict in verdicts}
    columns = "".join(f"{errors.get(name, ''):>9}" for name in _COLUMNS)
    line = f"{verdicts[0].case:<{_NAME}}  {worst(verdicts):<15}  {columns}  {_gradients(verdicts)}".rstrip()
    failed = [verdict for verdict in verdicts if verdict.outcome == Outcome.FAILED]
    return "\n".join([line, *(f"    {verdict.dtype}: {verdict.note}" for verdict in failed)])


def worst(verdicts: Sequence[Verdict]) -> Outcome:
    """The outcome that a person has to hear of first."""
    return min((verdict.outcome for verdict in verdicts), key=_SEVERITY.index)


def summary(by_case: Mapping[Case, Sequence[Verdict]]) -> str:
    """One line a stage, in Markdown: how many cases ended how, worst errors, and precisions left out."""
    lines = [
        "| stage | cases | finite | one clear error | not run | FAILED | "
        + " | ".join(f"worst error, {name}" for name in _COLUMNS)
        + " | finite gradients |",
        "| --- |" + " ---: |" * (6 + len(_COLUMNS)),
    ]
    for stage in stages(list(by_case)):
        found = [verdicts for case, verdicts in by_case.items() if case.stage == stage]
        outcomes = [worst(verdicts) for verdicts in found]
        counts = [outcomes.count(kind) for kind in reversed(_SEVERITY)]
        flat = [verdict for verdicts in found for verdict in verdicts]
        gradients = [verdict.gradient for verdict in flat if verdict.gradient is not None]
        cells = [stage.name, len(found), *counts, *(_worst_error(flat, name) for name in _COLUMNS)]
        cells.append(f"{sum(gradients)} of {len(gradients)}" if gradients else "–")
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def notes(cases: Sequence[Case]) -> list[str]:
    """Why some stages are not run in every precision."""
    return [
        f"{stage.name}: {', '.join(dtype_name(dtype) for dtype in stage.dtypes)}; {stage.note}."
        for stage in stages(cases)
        if stage.note
    ]


def to_json(by_case: Mapping[Case, Sequence[Verdict]], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that was found, JSON-safe; an error that is no number is null."""
    verdicts = [asdict(verdict) for verdicts in by_case.values() for verdict in verdicts]
    for verdict in verdicts:
        if verdict["error"] is not None and not math.isfinite(verdict["error"]):
            verdict["error"] = None
        verdict["outcome"] = str(verdict["outcome"])
    return {"schema": "relight-stress", "version": 1, **facts, "verdicts": verdicts}


def machine_facts() -> dict[str, Any]:
    """What the numbers depend on."""
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else "no card"
    return {"torch": torch.__version__, "threads": torch.get_num_threads(), "card": card}


def _worst_error(verdicts: Sequence[Verdict], dtype: str) -> str:
    errors = [v.error for v in verdicts if v.dtype == dtype and v.error is not None]
    return _number(max(errors)) if errors else "–"


def _number(error: float | None) -> str:
    if error is None:
        return "–"
    return "0" if error == 0 else f"{error:.1e}"


def _gradients(verdicts: Sequence[Verdict]) -> str:
    asked = [verdict.gradient for verdict in verdicts if verdict.gradient is not None]
    if not asked:
        return ""
    return "finite" if all(asked) else "NOT FINITE"
