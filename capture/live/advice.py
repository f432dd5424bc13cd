"""The one sentence for the operator: what matters most now, and not another one every moment."""

from __future__ import annotations

from capture.live.state import LiveState

_HOLD_S = 1.5  # a sentence stays so long, unless a weightier one comes
_CLIPPED, _DARK_LEVEL = 0.04, 0.10
_PERIODS_WITHOUT = 2.6
_RESTLESS, _BLURRED = 0.6, 0.55
_ENOUGH_DEG = 150.0
_SLOW_DEG_S = 2.0
_FIRST_S = 3.0  # nothing is said of the walk before


class Adviser:
    """Chooses and holds the sentence."""

    def __init__(self) -> None:
        self._rank, self._sentence, self._since_s = 99, "", -1e9

    def choose(
        self,
        state: LiveState,
        *,
        without_flash_s: float,
        period_s: float | None,
        blurred: float,
        walk_deg_s: float,
    ) -> str:
        """The sentence for a state.

        Args:
            state: without advice.
            without_flash_s: since a flash was seen last, or since the beginning.
            period_s: of the train; None = none runs.
            blurred: share of the last second's unlit frames that are blurred.
            walk_deg_s: speed of the walk around the head.
        """
        rank, sentence = _most_important(state, without_flash_s, period_s, blurred, walk_deg_s)
        now_s = state.elapsed_s
        if rank < self._rank or now_s - self._since_s >= _HOLD_S:
            if sentence != self._sentence:
                self._since_s = now_s
            self._rank, self._sentence = rank, sentence
        return self._sentence


def _most_important(
    state: LiveState, without_flash_s: float, period_s: float | None, blurred: float, walk_deg_s: float
) -> tuple[int, str]:
    span = state.coverage.span_deg
    if state.finished:
        return 0, "done"
    if period_s is not None and without_flash_s > _PERIODS_WITHOUT * period_s:
        return 1, "flash not seen: is it on, and does it reach the head?"
    if state.clipped_subject > _CLIPPED:
        return 2, "too bright: lower the exposure"
    if state.frames > 10 and state.level < _DARK_LEVEL and (state.level_lit or 0.0) < _DARK_LEVEL:
        return 3, "too dark: raise the exposure"
    if state.motion is not None and state.motion > _RESTLESS:
        return 4, "hold still: the head moved"
    if blurred > _BLURRED:
        return 5, "slower: blurred"
    if state.elapsed_s > _FIRST_S and span is not None and span < _ENOUGH_DEG and walk_deg_s < _SLOW_DEG_S:
        return 6, "move on around the head"
    if state.elapsed_s > _FIRST_S and span is None:
        return 7, "the walk cannot be measured: nothing to follow behind the head"
    return 9, ""
