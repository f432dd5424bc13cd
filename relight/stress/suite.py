"""All cases, in the order in which a capture meets their stages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache

from relight.errors import StressError
from relight.stress import (
    drift,
    environments,
    gradients,
    lights,
    measures,
    networks,
    observing,
    projecting,
    refining,
    reflecting,
    relighting,
    rendering,
    solving,
    training,
)
from relight.stress.case import Case, Stage

_MODULES: tuple[Callable[[], Iterator[Case]], ...] = (
    observing.cases,
    solving.cases,
    projecting.cases,
    rendering.cases,
    reflecting.cases,
    lights.cases,
    environments.cases,
    relighting.cases,
    measures.cases,
    networks.cases,
    training.cases,
    refining.cases,
    gradients.cases,
    drift.cases,
)


@cache
def all_cases() -> tuple[Case, ...]:
    """The suite."""
    return tuple(case for cases in _MODULES for case in cases())


def chosen_cases(names: Sequence[str] = (), *, long: bool = True) -> tuple[Case, ...]:
    """Those whose name has one of some texts in it; all where none is given.

    Args:
        names: Texts; upper and lower case are the same.
        long: Whether the long ones are wanted.

    Raises:
        StressError: No case has such a name.
    """
    wanted = [name.lower() for name in names]
    found = tuple(
        case
        for case in all_cases()
        if (long or not case.long) and (not wanted or any(name in case.name.lower() for name in wanted))
    )
    if not found:
        known = ", ".join(stage.name for stage in stages(all_cases()))
        raise StressError(f"No case has {' or '.join(map(repr, names))} in its name; the stages are {known}.")
    return found


def stages(cases: Sequence[Case]) -> tuple[Stage, ...]:
    """The stages of some cases, each once."""
    return tuple(dict.fromkeys(case.stage for case in cases))
