"""What the judge of the stress suite lets pass and what not."""

import warnings

import numpy as np
import pytest
import torch

from relight.errors import PlanError
from relight.stress.case import (
    Case,
    Measured,
    NotRunError,
    Outcome,
    Stage,
    at_most,
    epsilons,
    gradients_of,
    judge,
    worst_error,
)

STAGE = Stage("a stage", (torch.float64, torch.float32), "so")


def verdicts_of(run, **options):
    return judge(Case(STAGE, "an input", run, **options))


def third(dtype, off=0.0):
    return Measured({"x": torch.tensor([1.0, 1.0 / 3.0 + off * (dtype == torch.float32)], dtype=dtype)})


def test_rounding_passes_and_its_size_is_told():
    exact, rounded = verdicts_of(third, bound=epsilons(1))
    assert exact.outcome == rounded.outcome == Outcome.FINITE
    assert exact.error is None  # it is the reference
    # A third in 24 bits is off by less than half of the last of them, 2^-25 times 1/2 .. 1.
    assert 0 < rounded.error < 2.0**-25


def test_an_error_above_the_bound_fails():
    _, off = verdicts_of(lambda dtype: third(dtype, 1e-3), bound=epsilons(4))
    assert off.outcome == Outcome.FAILED
    assert "error 0.001 above 4.8e-07" in off.note


def test_an_error_of_the_cases_own_is_held_against_the_bound_in_float64_too():
    for error, outcome in ((0.5, Outcome.FINITE), (0.7, Outcome.FAILED), (np.nan, Outcome.FAILED)):
        found = verdicts_of(lambda dtype, error=error: Measured({}, error=error), bound=at_most(0.6))
        assert [verdict.outcome for verdict in found] == [outcome, outcome]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_value_that_is_no_number_fails(value):
    found = verdicts_of(lambda dtype: Measured({"x": torch.tensor([1.0, value], dtype=dtype)}))
    assert all(verdict.outcome == Outcome.FAILED and "x (1 of 2)" in verdict.note for verdict in found)


def test_a_gradient_that_is_no_number_fails():
    def root(dtype):
        at = torch.zeros(1, dtype=dtype, requires_grad=True)
        return Measured({"x": at.sqrt()}, gradients_of(at.sqrt(), at=at))

    found = verdicts_of(root)
    assert all(verdict.outcome == Outcome.FAILED and verdict.gradient is False for verdict in found)


def test_a_clear_refusal_passes_where_it_is_due():
    def refuse(dtype):
        raise PlanError("There are no frames; add some.")

    assert {verdict.outcome for verdict in verdicts_of(refuse, refused=PlanError)} == {Outcome.REFUSED}
    assert {verdict.outcome for verdict in verdicts_of(refuse)} == {Outcome.FAILED}


@pytest.mark.parametrize("text", ["", "no full stop", "Two lines\nare none."])
def test_an_unclear_refusal_fails(text):
    def refuse(dtype):
        raise PlanError(text)

    assert {verdict.outcome for verdict in verdicts_of(refuse, refused=PlanError)} == {Outcome.FAILED}


def test_another_error_than_the_one_that_is_due_fails():
    def refuse(dtype):
        raise IndexError("index 3 is out of range.")

    assert {verdict.outcome for verdict in verdicts_of(refuse, refused=PlanError)} == {Outcome.FAILED}


def test_an_answer_where_a_refusal_is_due_fails():
    found = verdicts_of(third, refused=PlanError)
    assert all(verdict.note == "an answer where PlanError is due" for verdict in found)


def test_a_warning_of_an_overflow_fails():
    def overflow(dtype):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            return Measured({"x": torch.tensor(np.float32(1e30) * np.float32(1e30) * 0)})

    assert {verdict.outcome for verdict in verdicts_of(overflow)} == {Outcome.FAILED}


def test_what_the_machine_does_not_have_is_not_run():
    def run(dtype):
        raise NotRunError("no card")

    assert {(verdict.outcome, verdict.note) for verdict in verdicts_of(run)} == {(Outcome.NOT_RUN, "no card")}


def test_only_wanted_precisions_of_the_stage_are_run():
    case = Case(STAGE, "an input", third)
    assert [verdict.dtype for verdict in judge(case, (torch.float32, torch.bfloat16))] == ["float32"]
    assert judge(case, (torch.bfloat16,)) == []


def test_errors_are_relative_to_the_largest_value():
    small = {"x": torch.tensor([1e-6, 2e-6], dtype=torch.float64), "nothing": torch.zeros(0)}
    assert worst_error(small | {"x": small["x"] * 1.5}, small) == pytest.approx(0.5)
    assert worst_error({"x": torch.tensor([0.25])}, {"x": torch.zeros(1)}) == 0.25  # of black: the value
