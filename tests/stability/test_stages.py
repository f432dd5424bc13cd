"""The suite of `relight stress` without its cases of millions of points: every verdict is the right one."""

import pytest
import torch

from relight.stress.case import Outcome, judge
from relight.stress.suite import all_cases, chosen_cases, stages

CASES = chosen_cases(long=False)


@pytest.fixture(autouse=True)
def one_thread():
    """So that the tests of several workers do not wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_stage_gives_finite_values_near_the_reference_or_one_clear_error(case):
    verdicts = judge(case)
    wanted = Outcome.FINITE if case.refused is None else Outcome.REFUSED
    for verdict in verdicts:
        if verdict.outcome != Outcome.NOT_RUN:  # without a card
            assert verdict.outcome == wanted, f"{verdict.dtype}: {verdict.note}"
    assert verdicts


def test_names_are_unique():
    names = [case.name for case in all_cases()]
    assert len(set(names)) == len(names)


def test_a_stage_that_is_not_run_in_every_precision_says_why():
    for stage in stages(all_cases()):
        assert len(stage.dtypes) == 3 or stage.note, stage.name
