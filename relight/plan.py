"""What a plan is: per step whether it runs, with the reason (made by `relight.planning`).

A decision is one of

    run     the step is needed
    skip    the scene does not need it; the same result without
    given   the session brings the step's result
    kept    an earlier run left the result, and nothing that it depends on has changed
    refuse  the fit cannot be done as the session is; the reason says what to add

Where both ways are possible the decision can be forced (`FORCEABLE`). Only steps that this version has are
decided.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from relight.errors import PlanError

FORCEABLE = ("undistortion", "redundant_views", "room_shading", "masks", "face_prior")
"""Decisions that `--force NAME=run|skip` may turn round."""


class Action(StrEnum):
    """What becomes of a step."""

    RUN = "run"
    SKIP = "skip"
    GIVEN = "given"
    KEPT = "kept"
    REFUSE = "refuse"


@dataclass(frozen=True)
class Decision:
    """What becomes of one step, and why.

    Attributes:
        name: The step.
        action: What becomes of it.
        reason: For a person, one sentence without its full stop.
        saving: What a skip spares, where that is known.
        forced: Whether the user turned it round.
        estimated_s: Seconds that the step should take on two cores; 0 where that is next to nothing.
        settings: Resolved, of a step that has any.
    """

    name: str
    action: Action
    reason: str
    saving: str = ""
    forced: bool = False
    estimated_s: float = 0.0
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """The decisions for one session, and the frames that the fit will use.

    Attributes:
        decisions: In the order of the work.
        frames: Indices of the frames to fit, in capture order.
        left_out: Per frame index that is not fitted, why.
        estimated_s: Seconds that the fit should take on two cores.
    """

    decisions: tuple[Decision, ...]
    frames: tuple[int, ...]
    left_out: Mapping[int, str] = field(default_factory=dict)
    estimated_s: float = 0.0

    def decision(self, name: str) -> Decision:
        """The decision of that name."""
        return next(decision for decision in self.decisions if decision.name == name)

    def runs(self, name: str) -> bool:
        """Whether the step is done."""
        return self.decision(name).action is Action.RUN

    def after(self, earlier: Plan) -> Plan:
        """This plan, made when the steps of an earlier one were done, with the earlier one's word on them."""
        ran = {decision.name: decision for decision in earlier.decisions if decision.action is Action.RUN}
        decisions = (
            ran[decision.name] if decision.action is Action.KEPT and decision.name in ran else decision
            for decision in self.decisions
        )
        return replace(self, decisions=tuple(decisions), estimated_s=earlier.estimated_s)

    def with_decision(self, decision: Decision) -> Plan:
        """The plan with a decision in the place of the one of its name."""
        decisions = tuple(decision if each.name == decision.name else each for each in self.decisions)
        return replace(self, decisions=decisions)

    def check(self) -> None:
        """Does nothing for a session that can be fitted.

        Raises:
            PlanError: It cannot; the message names what is missing first.
        """
        refusals = [decision for decision in self.decisions if decision.action is Action.REFUSE]
        if refusals:
            more = f" ({len(refusals) - 1} more: see `relight plan`)" if len(refusals) > 1 else ""
            raise PlanError(f"{refusals[0].reason}{more}.")

    def as_json(self) -> dict[str, Any]:
        """For plan.json and `relight plan --json`."""
        return {
            "decisions": [
                {
                    "name": decision.name,
                    "action": decision.action.value,
                    "reason": decision.reason,
                    "saving": decision.saving,
                    "forced": decision.forced,
                    "estimated_s": round(decision.estimated_s, 1),
                    "settings": dict(decision.settings),
                }
                for decision in self.decisions
            ],
            "frames": list(self.frames),
            "left_out": {str(index): why for index, why in self.left_out.items()},
            "estimated_s": round(self.estimated_s, 1),
        }


def parse_forced(texts: list[str]) -> dict[str, Action]:
    """The meaning of `--force NAME=run|skip` options.

    Raises:
        PlanError: Not of that form, or not a decision that can be forced.
    """
    forced = {}
    for text in texts:
        name, _, action = text.partition("=")
        if name not in FORCEABLE or action not in (Action.RUN, Action.SKIP):
            names = ", ".join(FORCEABLE)
            raise PlanError(f"--force {text} must be NAME=run or NAME=skip with NAME one of {names}.")
        forced[name] = Action(action)
    return forced
