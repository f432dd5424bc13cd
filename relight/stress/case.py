"""A case: one stage under one hostile input, and the verdict on what comes out of it.

What a stage may do is give finite values and gradients, as near to float64 as its precision allows, or refuse
with one clear sentence. Which of the two is right is part of the case: a refusal where an answer is due is a
failure, and so is an answer where there is none.

Errors are relative to the largest value of the reference, so that they mean the same at any intensity.
Overflows and invalid operations that numpy warns of count as failures: a person would see the warning.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum

import torch
from torch import Tensor

from capture.errors import RelightError

DTYPES = (torch.float64, torch.float32, torch.bfloat16)
"""From the finest to the coarsest."""

Bound = Callable[[torch.dtype], float]
"""Largest error that a precision may have."""


def dtype_name(dtype: torch.dtype) -> str:
    """As in "float32"."""
    return str(dtype).removeprefix("torch.")


def epsilons(count: float) -> Bound:
    """So many times the spacing of the numbers next to 1."""
    return lambda dtype: count * torch.finfo(dtype).eps


def at_most(error: float) -> Bound:
    """The same for every precision: of what has another cause than rounding."""
    return lambda dtype: error


class NotRunError(Exception):
    """A case cannot be run on this machine; the message says why."""


@dataclass(frozen=True)
class Stage:
    """A part of the program.

    Attributes:
        name: For the table.
        dtypes: Precisions that it is used in.
        note: Why not in the others; empty where it is used in all of `DTYPES`.
    """

    name: str
    dtypes: tuple[torch.dtype, ...] = DTYPES
    note: str = ""


@dataclass(frozen=True, eq=False)
class Measured:
    """What a stage made of a case.

    Attributes:
        values: By name; all have to be finite.
        gradients: By name, of a sum of the values; all have to be finite. Empty where none are asked for.
        error: Against a truth in float64 that the case itself knows; None = the values are compared with
            those of float64.
    """

    values: Mapping[str, Tensor]
    gradients: Mapping[str, Tensor] = field(default_factory=dict)
    error: float | None = None


_NOTHING = Measured({})


@dataclass(frozen=True, eq=False)
class Case:
    """One stage under one hostile input.

    Attributes:
        stage: What is stressed.
        stressed: How, for the table.
        run: Does it in a precision.
        bound: Largest error; None = only finiteness is asked for.
        refused: The error that is the right answer; None = an answer is due.
        dtypes: Precisions to run it in; empty = those of the stage.
        long: Whether it takes too long, or too much memory, for a test.
    """

    stage: Stage
    stressed: str
    run: Callable[[torch.dtype], Measured]
    bound: Bound | None = None
    refused: type[Exception] | None = None
    dtypes: tuple[torch.dtype, ...] = ()
    long: bool = False

    @property
    def name(self) -> str:
        """For the table and `--only`."""
        return f"{self.stage.name}: {self.stressed}"

    def precisions(self, wanted: Sequence[torch.dtype] = DTYPES) -> tuple[torch.dtype, ...]:
        """Those of the wanted ones that the case has."""
        return tuple(dtype for dtype in self.dtypes or self.stage.dtypes if dtype in wanted)


class Outcome(StrEnum):
    """What became of a case."""

    FINITE = "finite"
    REFUSED = "one clear error"
    FAILED = "FAILED"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class Verdict:
    """The outcome of a case in one precision.

    Attributes:
        case: Its name.
        dtype: As in "float32".
        outcome: See there.
        error: Worst, relative to the largest value of the reference; None where nothing was compared, as of
            float64 with itself.
        bound: What it may be.
        gradient: Whether gradients were finite; None where none were asked for.
        note: The sentence of a refusal, or what failed, or why it was not run.
        seconds: Wall time, of the reference too.
    """

    case: str
    dtype: str
    outcome: Outcome
    error: float | None = None
    bound: float | None = None
    gradient: bool | None = None
    note: str = ""
    seconds: float = 0.0


def judge(case: Case, dtypes: Sequence[torch.dtype] = DTYPES) -> list[Verdict]:
    """Runs a case in each of the wanted precisions that it has."""
    reference: dict[str, Mapping[str, Tensor]] = {}

    def in_float64() -> Mapping[str, Tensor]:
        if "values" not in reference:
            reference["values"] = case.run(torch.float64).values
        return reference["values"]

    return [_judged(case, dtype, in_float64) for dtype in case.precisions(dtypes)]


def _judged(case: Case, dtype: torch.dtype, reference: Callable[[], Mapping[str, Tensor]]) -> Verdict:
    started_s = time.perf_counter()
    name = dtype_name(dtype)
    bound = None if case.bound is None else case.bound(dtype)

    def verdict(
        outcome: Outcome, note: str, found: Measured = Measured({}), error: float | None = None
    ) -> Verdict:
        return Verdict(
            case.name,
            name,
            outcome,
            error=error,
            bound=bound,
            gradient=_broken(found.gradients) == "" if found.gradients else None,
            note=note,
            seconds=time.perf_counter() - started_s,
        )

    try:
        with warnings.catch_warnings(), _quiet():
            warnings.simplefilter("error", RuntimeWarning)
            found = case.run(dtype)
            error = found.error
            if error is None and bound is not None and dtype != torch.float64:
                error = worst_error(found.values, reference())
    except NotRunError as reason:
        return verdict(Outcome.NOT_RUN, str(reason))
    except Exception as raised:
        if case.refused is not None and isinstance(raised, case.refused) and _is_clear(raised):
            return verdict(Outcome.REFUSED, str(raised))
        return verdict(Outcome.FAILED, f"{type(raised).__name__}: {raised}")
    wrong = ""
    if case.refused is not None:
        wrong = f"an answer where {case.refused.__name__} is due"
    elif broken := _broken(found.values):
        wrong = f"values not finite: {broken}"
    elif broken := _broken(found.gradients):
        wrong = f"gradients not finite: {broken}"
    elif bound is not None and error is not None and not error <= bound:
        wrong = f"error {error:.2g} above {bound:.2g}"
    return verdict(Outcome.FAILED if wrong else Outcome.FINITE, wrong, found, error)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what a stage logs for its user: a repaired pixel is no news here."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def gradients_of(outputs: Tensor, **inputs: Tensor) -> dict[str, Tensor]:
    """Gradients of a sum of outputs in the inputs that it depends on; none where it depends on none."""
    if not outputs.requires_grad:
        return {}
    found = torch.autograd.grad(outputs.sum(), list(inputs.values()), allow_unused=True)
    return {name: value for name, value in zip(inputs, found, strict=True) if value is not None}


def worst_error(values: Mapping[str, Tensor], reference: Mapping[str, Tensor]) -> float:
    """Largest difference of any value, relative to the largest value of its reference; 0 of nothing."""
    worst = 0.0
    for name, expected in reference.items():
        if expected.numel():
            value, expected = values[name].detach().double(), expected.detach().double()
            scale = float(expected.abs().max())
            worst = max(worst, float((value - expected).abs().max()) / (scale if scale > 0 else 1.0))
    return worst


def _broken(tensors: Mapping[str, Tensor]) -> str:
    """Names of what is not finite, with the number of such values."""
    counts = {name: int((~tensor.detach().isfinite()).sum()) for name, tensor in tensors.items()}
    return ", ".join(
        f"{name} ({count} of {tensors[name].numel()})" for name, count in counts.items() if count
    )


def _is_clear(error: Exception) -> bool:
    """Whether an error is one sentence: of those for users it has to be whole and end as one."""
    text = str(error)
    return bool(text) and "\n" not in text and (not isinstance(error, RelightError) or text[-1] in ".?")
