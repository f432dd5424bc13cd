"""The tagger on simulated videos whose every row's light is known (`benchmarks.blinking_video`)."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.blinking_video import Video, frames, make_truth
from capture.errors import TaggingError
from capture.tagging import FlashPrior, ProfileAccumulator, tag, tag_frames

# The period is no multiple of the frame interval: pulses meet all phases of the shutter.
BASE = Video(duration_s=8.0, period_s=1.013, timer="phone", background_gain=0.1)


@lru_cache(maxsize=32)
def seen(video):
    accumulator = ProfileAccumulator(video.width, video.height, transfer="srgb")
    for picture, pts_s in frames(video):
        accumulator.add(picture, pts_s)
    return accumulator.profiles()


@lru_cache(maxsize=32)
def tagged(video):
    return make_truth(video), tag(seen(video))


def wrong(truth, result):
    """Frames called lit or unlit that are not: (false lit, false unlit)."""
    pairs = list(zip(truth.labels, (frame.flash for frame in result.frames), strict=True))
    return (
        [k for k, (true, given) in enumerate(pairs) if given == 1 and true != 1],
        [k for k, (true, given) in enumerate(pairs) if given == 0 and true != 0],
    )


def found(truth, result, label):
    """Share of the frames of a label that got it."""
    given = [frame.flash for true, frame in zip(truth.labels, result.frames, strict=True) if true == label]
    return sum(flash == label for flash in given) / max(1, len(given))


CASES = {
    "walk": BASE,
    "hand": replace(BASE, motion="hand", seed=1),
    "fast readout": replace(BASE, readout_s=0.010, seed=2),
    "slow readout, short pulse": replace(BASE, readout_s=0.033, on_s=0.06, seed=3),
    "long pulse": replace(BASE, on_s=0.15, seed=4),
    "bright room": replace(BASE, gain=0.5, background_gain=0.08, seed=5),
    "bottom row first": replace(BASE, readout_s=-0.02, seed=6),
    "global shutter": replace(BASE, readout_s=0.0, exposure_s=0.008, seed=7),
    "dropped frames": replace(BASE, dropped=0.1, seed=8),
    "lamp droops": replace(BASE, droop=0.05, seed=9),
    "tripod": replace(BASE, motion="still", seed=10),
    "colour": replace(BASE, color=True, seed=11),
}


@pytest.mark.parametrize("name", CASES)
def test_no_frame_is_called_lit_or_unlit_that_is_not(name):
    truth, result = tagged(CASES[name])
    assert wrong(truth, result) == ([], [])


@pytest.mark.parametrize("name", CASES)
def test_unlit_frames_partial_frames_and_pulses_are_found(name):
    truth, result = tagged(CASES[name])
    # Uncertain frames are called partial, at most a few beside the edges of a pulse.
    assert found(truth, result, 0) > 0.9
    assert found(truth, result, None) == 1.0
    inside = (truth.off_s > truth.pts_s[0]) & (truth.on_s < truth.pts_s[-1])
    assert len(result.pulses) == inside.sum()


def test_most_fully_lit_frames_are_found():
    videos = [CASES[name] for name in ("walk", "hand", "fast readout", "long pulse")]
    results = [tagged(video) for video in videos]
    lit = sum(truth.labels.count(1) for truth, _ in results)
    hit = sum(
        true == frame.flash == 1
        for truth, result in results
        for true, frame in zip(truth.labels, result.frames, strict=True)
    )
    # A frame that an edge misses by less than the edge is known is called partial: about one in six here,
    # where the shutter is unknown and each pulse has two to three lit frames.
    assert hit / lit > 0.75


def test_lit_fraction_is_the_mean_share_of_the_rows():
    truth, result = tagged(CASES["tripod"])
    for lit, frame in zip(truth.lit, result.frames, strict=True):
        if frame.lit_fraction is not None:
            # Edges are known to about a millisecond, readout and exposure together are 25 ms.
            assert frame.lit_fraction == pytest.approx(lit.mean(), abs=0.12)


def test_period_and_pulses_are_recovered():
    truth, result = tagged(CASES["walk"])
    # The phone's timer is late by a few milliseconds a pulse; its own mean period is the truth.
    assert result.period_s == pytest.approx(np.diff(truth.on_s).mean(), abs=0.01)
    starts = [pulse.t_on_s for pulse in result.pulses]
    inside = truth.on_s[(truth.off_s > truth.pts_s[0]) & (truth.on_s < truth.pts_s[-1])]
    # A start can fall between two exposures, where nothing sees it: up to a frame less an exposure.
    assert np.abs(np.array(starts) - inside).max() < 1 / 30


def test_missed_pulses_are_reported():
    truth, result = tagged(replace(BASE, missed=(3,), duration_s=9.0, seed=12))
    assert wrong(truth, result) == ([], [])
    assert len(result.missed_s) == 1


def test_mains_flicker_is_told_from_partial_flash():
    video = replace(BASE, flicker_hz=100.06, flicker_depth=0.3, seed=13)
    truth, result = tagged(video)
    assert wrong(truth, result) == ([], [])
    assert found(truth, result, 0) > 0.8
    assert result.flicker_hz == pytest.approx(100.0, abs=1.0)


@pytest.mark.parametrize(
    "video",
    [
        replace(BASE, flash=False, motion="walk", seed=20),
        replace(BASE, flash=False, motion="hand", seed=21),
        replace(BASE, flash=False, motion="still", seed=22),
        replace(BASE, always_on=True),
        replace(BASE, flash=False, flicker_hz=100.0, flicker_depth=0.3),
        replace(BASE, flash=False, step_at_s=4.0, step=(1.3, 1.3, 1.3)),
    ],
    ids=["none, walk", "none, hand", "none, still", "always on", "flicker only", "a step of exposure only"],
)
def test_without_pulses_nothing_is_tagged(video):
    with pytest.raises(TaggingError) as refusal:
        tag(seen(video))
    assert str(refusal.value).endswith(".")


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_frames_are_refused(count):
    with pytest.raises(TaggingError):
        tag_frames([(np.full((90, 160), 60, np.uint8), k / 30) for k in range(count)], transfer="srgb")


def test_times_may_start_anywhere():
    video = CASES["hand"]
    moved = seen(video)
    later = replace(moved, pts_s=moved.pts_s + 1000.0)
    here, there = tag(moved), tag(later)
    assert [frame.flash for frame in here.frames] == [frame.flash for frame in there.frames]
    # Times of 1000 s have a spacing of 1e-13 s; the fit's own tolerance is what is left.
    assert there.pulses[0].t_on_s - here.pulses[0].t_on_s == pytest.approx(1000.0, abs=1e-3)


def test_black_and_empty_frames_are_kept_and_marked():
    video = CASES["hand"]
    moved = seen(video)
    readable, codes = moved.readable.copy(), moved.codes.copy()
    readable[100], codes[100] = False, 0
    result = tag(replace(moved, readable=readable, codes=codes))
    assert len(result.frames) == len(moved.pts_s)
    assert result.frames[100].flash is None
    assert "unreadable" in result.frames[100].reasons


def test_a_right_schedule_is_confirmed_with_its_offset():
    truth, _ = tagged(CASES["walk"])
    prior = FlashPrior(tuple(truth.on_s + 5.0), 0.1, "flash.csv")
    result = tag(seen(CASES["walk"]), schedule=prior)
    assert result.prior is not None
    # Starts are known to a few milliseconds, their mean better.
    assert result.prior.offset_s == pytest.approx(-5.0, abs=0.01)
    assert wrong(truth, result) == ([], [])


def test_a_schedule_of_another_recording_is_contradicted():
    times = tuple(np.cumsum(np.random.default_rng(0).uniform(0.4, 1.9, 8)))
    with pytest.raises(TaggingError, match=r"flash\.csv"):
        tag(seen(CASES["walk"]), schedule=FlashPrior(times, 0.1, "flash.csv"))
