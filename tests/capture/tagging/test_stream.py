"""Tagging while a capture runs, on frames whose every row's light is known (`benchmarks.soak_scene`)."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.soak import run_soak
from benchmarks.soak_scene import COLUMNS, ROWS, Soak, soak_frames
from capture.errors import TaggingError
from capture.tagging import FrameTag, ProfileAccumulator, StreamTagger, TaggingConfig, tag

# Nothing goes wrong; the period is no multiple of the frames', so that pulses meet all phases of the shutter.
QUIET = Soak(
    pulses=17,
    period_s=1.013,
    missed=0.0,
    reset_every=1e9,
    dropped=0.0,
    burst_every=1e9,
    stall_every=1e9,
    restart_every=1e9,
    unreadable_every=1e9,
    flicker=0.0,
    droop=0.0,
)
CONFIG = TaggingConfig(
    exposure_s=QUIET.exposure_s, readout_s=QUIET.readout_s, risk=0.001, stamp_sigma_s=QUIET.stamp_s
)
# Stretches so short that a test has several.
SHORT = {"chunk_s": 6.0, "margin_s": 3.0}


@lru_cache(maxsize=8)
def filmed(soak):
    return tuple(soak_frames(soak))


def streamed(frames, *, schedule=False, config=CONFIG, **sizes):
    """Tags by position, and the result."""
    tagger = StreamTagger(COLUMNS, ROWS, config=config, **(sizes or SHORT))
    tags: list[tuple[int, FrameTag]] = []
    for k, frame in enumerate(frames):
        if schedule and frame.events:
            tagger.expect(frame.events, QUIET.on_s)
        tagger.add(frame.picture, frame.pts_s)
        if k % 90 == 0:
            tags += tagger.ready()
    result = tagger.finish()
    tags += result.frames
    assert [position for position, _ in tags] == list(range(len(frames)))
    return [frame_tag for _, frame_tag in tags], result


@lru_cache(maxsize=1)
def quiet():
    """The undisturbed capture with its schedule: frames, tags, result."""
    return filmed(QUIET), *streamed(filmed(QUIET), schedule=True)


def wrong(frames, tags):
    """Frames called lit or unlit that are not."""
    return [
        k
        for k, (frame, given) in enumerate(zip(frames, tags, strict=True))
        if given.flash is not None and given.flash != frame.label
    ]


def test_a_short_capture_is_tagged_as_a_whole_one():
    frames = filmed(QUIET)[:240]
    accumulator = ProfileAccumulator(COLUMNS, ROWS, transfer="srgb")
    for frame in frames:
        accumulator.add(frame.picture, frame.pts_s)
    whole = tag(accumulator.profiles(), config=CONFIG)
    tags, result = streamed(frames, chunk_s=40.0, margin_s=6.0)
    assert tuple(tags) == whole.frames
    assert result.warnings == whole.warnings
    assert (result.period_s, result.readout_s, result.pulses) == (
        whole.period_s,
        whole.readout_s,
        len(whole.pulses),
    )


def test_a_short_capture_without_flash_is_refused_as_a_whole_one():
    frames = [replace(frame, picture=filmed(QUIET)[0].picture) for frame in filmed(QUIET)[:120]]
    accumulator = ProfileAccumulator(COLUMNS, ROWS, transfer="srgb")
    for frame in frames:
        accumulator.add(frame.picture, frame.pts_s)
    with pytest.raises(TaggingError) as refusal:
        tag(accumulator.profiles())
    tags, result = streamed(frames, config=None)
    assert result.refused == str(refusal.value)
    assert {(given.flash, given.reasons) for given in tags} == {(None, ("untagged",))}


def test_an_empty_capture_is_refused():
    assert StreamTagger(COLUMNS, ROWS).finish().refused is not None


def test_where_stretches_end_makes_no_difference_that_matters():
    frames, one, result = quiet()
    other, _ = streamed(frames, schedule=True, chunk_s=7.7, margin_s=3.0)
    assert wrong(frames, one) == wrong(frames, other) == []
    assert result.pulses == QUIET.pulses
    # A frame at an edge, of which there are two a pulse, is called uncertain by one and not by the other.
    differ = sum(a.flash != b.flash for a, b in zip(one, other, strict=True))
    assert differ <= 0.2 * QUIET.pulses


def test_memory_holds_one_stretch_of_frames():
    tagger = StreamTagger(COLUMNS, ROWS, config=CONFIG, chunk_s=4.0, margin_s=2.0)
    held = []
    for k, frame in enumerate(filmed(QUIET)[:420]):
        tagger.add(frame.picture, frame.pts_s)
        if k % 30 == 0:
            tagger.ready()
            held.append(tagger.held)
    # A stretch of 8 s, and what comes in the second until `ready` is asked again.
    assert max(held) <= 30 * (8 + 1) + 1


def test_a_dead_flash_leaves_frames_unlit_or_untagged():
    soak = replace(QUIET, pulses=8, dark_s=14.0)
    frames = filmed(soak)
    tags, result = streamed(frames, schedule=True)
    assert wrong(frames, tags) == []
    assert result.pulses == 8
    dark = [given.flash for frame, given in zip(frames, tags, strict=True) if frame.pts_s > 10]
    # The camera stands still in this scene's first minutes, so the light says it of most.
    assert dark.count(0) > 0.9 * len(dark)


def test_a_gap_in_time_begins_a_segment_with_its_own_rhythm():
    frames = [frame for frame in filmed(QUIET) if not 8.2 < frame.pts_s < 10.9]
    # after the gap, the flash has started anew at another phase: the gap is 60.37 s longer in truth
    moved = [replace(f, pts_s=f.pts_s + 60.37, events=()) if f.pts_s > 9 else f for f in frames]
    tags, result = streamed(moved)
    assert wrong(moved, tags) == []
    assert result.segments == 2
    assert result.missed == result.phase_jumps == 0
    first = next(k for k, frame in enumerate(moved) if frame.pts_s > 60)
    assert "dropped_before" in tags[first].reasons


def test_a_segment_too_short_to_be_tagged_is_not_guessed():
    frames = [frame for frame in filmed(QUIET)[:420] if not 9.0 < frame.pts_s < 13.8]
    tags, _ = streamed(frames)
    assert wrong(frames, tags) == []
    assert all(given.flash is None for frame, given in zip(frames, tags, strict=True) if frame.pts_s > 13.8)


def test_the_schedule_gives_the_latency():
    _, _, result = quiet()
    assert result.matched == QUIET.pulses
    # The lamp is 4 ms late; a start is seen to a fraction of a millisecond, and readout and exposure enter.
    assert result.latency_s == pytest.approx(0.004, abs=1e-3)
    assert result.unseen == result.unscheduled == result.contradictions == 0
    assert result.period_s == pytest.approx(1.013, abs=1e-4)


def test_frames_that_contradict_the_schedule_are_left_out():
    frames = list(filmed(QUIET))
    # pulse 8 is reported but does not light: its frames are those of the second before it
    lit = [k for k, frame in enumerate(frames) if 8 in frame.pulses]
    for k in lit:
        frames[k] = replace(frames[k], picture=frames[lit[0] - 3].picture)
    tags, result = streamed(frames, schedule=True)
    assert result.unseen == 1
    assert result.contradictions >= 2
    assert all(tags[k].flash is None for k in lit if frames[k].most > 0.6)
    assert any("contradict" in text for text in result.warnings)


def test_a_schedule_of_another_flash_is_not_believed():
    rng = np.random.default_rng(0)
    frames = [replace(f, events=()) for f in filmed(QUIET)]
    strange = np.cumsum(rng.uniform(0.4, 1.9, 15))
    for time_s in strange:
        k = min(int(time_s * 30), len(frames) - 1)
        frames[k] = replace(frames[k], events=(float(time_s),))
    tags, result = streamed(frames, schedule=True)
    assert wrong(frames, tags) == []
    assert any("does not fit" in text or "not in the frames" in text for text in result.warnings)


def test_a_capture_of_two_pulses_does_not_contradict_its_schedule():
    frames = filmed(QUIET)[:75]
    assert sum(len(frame.events) for frame in frames) in (2, 3)
    _, result = streamed(frames, schedule=True)
    assert not any("does not fit" in text for text in result.warnings)


def test_pulses_are_counted_while_they_come():
    tagger = StreamTagger(COLUMNS, ROWS, config=CONFIG)
    for frame in filmed(QUIET)[:200]:
        tagger.expect(frame.events, QUIET.on_s)
        tagger.add(frame.picture, frame.pts_s)
        status = tagger.pulse_status()
    # The last second's may still be on the way.
    assert status.expected - 1 <= status.seen <= status.expected
    assert status.unseen == 0


def test_a_flash_that_is_not_seen_is_noticed_after_three_pulses():
    tagger = StreamTagger(COLUMNS, ROWS, config=CONFIG)
    dark = [frame for frame in filmed(QUIET) if frame.most == 0]
    seconds = 0.0
    for k, frame in enumerate(dark[:240]):
        if k % 30 == 0:
            tagger.expect([k / 30], QUIET.on_s)
        tagger.add(frame.picture, k / 30)
        seconds = k / 30
        if tagger.pulse_status().unseen >= 3:
            break
    assert tagger.pulse_status().seen == 0
    # Three pulses take two seconds, their frames one more, and the look is taken twice a second.
    assert seconds < 4.0


def test_frames_that_come_seconds_after_their_pulses_do_not_make_them_unseen():
    """A busy machine reads its frames late, while the flash's reports come in time."""
    late_s = 3.0
    frames = filmed(QUIET)[:200]
    events = [time_s for frame in frames for time_s in frame.events]
    tagger = StreamTagger(COLUMNS, ROWS, config=CONFIG)
    for frame in frames:
        tagger.add(frame.picture, frame.pts_s)
        while events and events[0] <= frame.pts_s + late_s:
            tagger.expect([events.pop(0)], QUIET.on_s)
        assert tagger.pulse_status().unseen <= 1


def test_pulses_before_a_break_are_not_waited_for_after_it():
    """Those of a killed capture, when it is gone on with: nobody asked while its frames came."""
    tagger = StreamTagger(COLUMNS, ROWS, config=CONFIG)
    dark = [frame for frame in filmed(QUIET) if frame.most == 0]
    for k, frame in enumerate(dark[:150]):
        tagger.add(frame.picture, k / 30)
    tagger.expect(range(5), QUIET.on_s)
    for k, frame in enumerate(dark[150:210]):
        tagger.add(frame.picture, 8.0 + k / 30)
        assert tagger.pulse_status().unseen == 0


def test_no_frame_of_a_troubled_capture_is_mistagged():
    soak = Soak(
        pulses=40,
        missed=0.03,
        reset_every=15,
        dropped=0.02,
        burst_every=300,
        stall_every=700,
        unreadable_every=500,
        seed=4,
    )
    result = run_soak(soak, scheduled=True, config=CONFIG, chunk_s=20.0)
    assert (result["false_lit"], result["false_unlit"]) == (0, 0)
    assert result["frames_without_tag"] == 0
    # A pulse of which a burst has left a single frame, or that a reset has cut to a trace, may not be found.
    assert result["pulses_found"] >= result["pulses"] - 2
    assert result["unlit_found"] > 0.9 * result["unlit"]
