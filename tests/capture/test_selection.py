"""Which frames are kept: all lit ones, the sharpest unlit one of each interval, none that is partly lit."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from capture.selection import Candidate, find_blurred, measure_sharpness, select_frames


def sequence(count: int, lit: set[int], partial: set[int] = frozenset(), seed: int = 0) -> list[Candidate]:
    """Frames at 30 Hz with random sharpness."""
    sharpness = np.random.default_rng(seed).uniform(0.5, 1.0, count)
    return [
        Candidate(k / 30, 1 if k in lit else None if k in partial else 0, float(sharpness[k]))
        for k in range(count)
    ]


def texture(seed: int = 0) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).random((240, 320)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.5) * 400 - 90


def test_all_lit_frames_are_kept_and_six_unlit_ones_a_second() -> None:
    lit = {k for start in range(0, 300, 30) for k in (start + 1, start + 2)}
    partial = {k for start in range(0, 300, 30) for k in (start, start + 3)}
    kept = select_frames(sequence(300, lit, partial), 6.0)
    assert lit <= kept
    assert not partial & kept
    assert len(kept - lit) == 60


def test_the_sharpest_of_each_interval_is_kept() -> None:
    frames = sequence(60, set())
    kept = select_frames(frames, 6.0)
    for start in range(0, 60, 5):
        best = max(range(start, start + 5), key=lambda k: frames[k].sharpness)
        assert kept & set(range(start, start + 5)) == {best}


def test_an_unsound_frame_is_not_kept_even_when_sharpest() -> None:
    frames = sequence(5, set())
    frames[2] = Candidate(2 / 30, 0, 9.0, sound=False)
    assert 2 not in select_frames(frames, 6.0)


def test_a_frame_with_a_pose_comes_before_a_sharper_one_without() -> None:
    frames = sequence(5, set())
    frames[3] = Candidate(3 / 30, 0, 0.01, posed=True)
    assert select_frames(frames, 6.0) == {3}


def test_intervals_follow_the_time_stamps_and_not_the_count() -> None:
    # A phone that drops to 10 Hz in the dark: one frame an interval is all there is.
    frames = [Candidate(5.0 + k / 10, 0, 1.0) for k in range(20)]
    # 20 frames in 1.9 s: intervals of 1/6 s hold one or two of them, 12 intervals in all.
    assert len(select_frames(frames, 6.0)) == 12


def test_a_limit_thins_both_kinds_evenly_in_time() -> None:
    lit = {k for start in range(0, 600, 30) for k in (start + 1, start + 2)}
    kept = select_frames(sequence(600, lit), 6.0, max_frames=40)
    assert len(kept) == 40
    assert len(kept & lit) == 20
    times = np.array(sorted(kept & lit)) / 30
    assert np.diff(times).max() < 2.1


def test_a_limit_above_the_number_changes_nothing() -> None:
    frames = sequence(100, {10, 11})
    assert select_frames(frames, 6.0, 1000) == select_frames(frames, 6.0)


@given(
    states=st.lists(st.sampled_from([0, 1, None]), max_size=60),
    limit=st.none() | st.integers(0, 70),
    rate=st.floats(0.1, 100),
)
def test_no_more_than_the_limit_and_never_a_partial_frame(
    states: list[int | None], limit: int | None, rate: float
) -> None:
    frames = [Candidate(k / 30, state, 1.0) for k, state in enumerate(states)]
    kept = select_frames(frames, rate, limit)
    assert all(states[k] is not None for k in kept)
    if limit is None:
        assert {k for k, state in enumerate(states) if state == 1} <= kept
    else:
        assert len(kept) <= limit


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_no_rate_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        select_frames([], rate)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_sharpness_falls_with_blur_and_does_not_see_the_light(kind: type) -> None:
    plain = texture()
    scale = 1 if kind is np.uint8 else 200
    values = [
        measure_sharpness((cv2.GaussianBlur(plain, (0, 0), sigma) * scale).astype(kind))
        for sigma in (0.5, 1, 2)
    ]
    assert all(a > 2 * b for a, b in pairwise(values))
    dim = measure_sharpness((plain * 0.7 * scale).astype(kind))
    # Truncation to whole codes adds noise of 1/12 code^2 to the Laplacian (20 samples^2): small beside the
    # texture.
    assert dim == pytest.approx(measure_sharpness((plain * scale).astype(kind)), rel=0.15)


def test_a_black_frame_has_no_sharpness() -> None:
    assert measure_sharpness(np.zeros((48, 64), np.uint8)) == 0.0


def test_blur_is_told_within_the_frames_of_the_same_flash() -> None:
    lit = {10, 11, 40, 41, 70, 71}
    # Lit frames are sharper by far; a blurred lit one still tops the unlit ones.
    frames = [Candidate(k / 30, int(k in lit), 10.0 if k in lit else 0.5) for k in range(90)]
    frames[41] = Candidate(41 / 30, 1, 1.5)
    frames[55] = Candidate(55 / 30, 0, 0.05)
    assert find_blurred(frames, range(90)) == {41, 55}


def test_nothing_is_blurred_in_nothing() -> None:
    assert find_blurred([], []) == frozenset()
