"""Which frames a fit leaves out to see how well it does where it was not fitted.

Pairs of a lit frame and the unlit one next to it in time, evenly over the capture; the paper holds five such
pairs out of some hundred frames (Sevastopolsky et al. 2020, section 4.1).
"""

from __future__ import annotations

from collections.abc import Sequence

from relight.scene import View

MOST_PAIRS = 5
FRAMES_A_PAIR = 5
"""Lit frames for each one that is left out: of fewer, none can be spared."""


def held_out(views: Sequence[View]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """The views to fit, and those to check with, which may be none."""
    lit = [view for view in views if view.flash == 1]
    unlit = [view for view in views if view.flash == 0]
    pairs = min(MOST_PAIRS, len(lit) // FRAMES_A_PAIR)
    kept: dict[int, View] = {}
    for pair in range(pairs):
        view = lit[int((pair + 0.5) * len(lit) / pairs)]
        kept[view.index] = view
        free = [other for other in unlit if other.index not in kept]
        if len(free) > 1:
            near = min(free, key=lambda other: abs(other.index - view.index))
            kept[near.index] = near
    fitted = tuple(view for view in views if view.index not in kept)
    return fitted, tuple(kept.values())
