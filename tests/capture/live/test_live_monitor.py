from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.devices.flash import FlashEdge
from capture.errors import TransferError
from capture.live import LiveMonitor


def make_monitor(**changes):
    values = {
        "width": 320,
        "height": 240,
        "transfer": "srgb",
        "fps": 30.0,
        "train_period_s": 1.0,
        "duration_s": 20.0,
        "focal_px": 280.0,
    }
    return LiveMonitor(**(values | changes))


def watch_film(film):
    first = film.frames[0].rgb
    monitor = make_monitor(
        width=first.shape[1],
        height=first.shape[0],
        fps=film.config.fps,
        train_period_s=film.config.lamp.period_s,
        duration_s=film.config.path.duration_s,
        focal_px=film.config.focal_px,
    )
    labels = [monitor.add(frame.rgb, frame.pts_s, k) for k, frame in enumerate(film.frames)]
    return monitor, labels


def test_the_walk_around_a_simulated_head_is_measured(walked_film):
    state = watch_film(walked_film)[0].snapshot()
    true_span = np.ptp(walked_film.azimuths_deg())
    # The walls of this room are not all at four times the head's distance: 1 - D/Z is uncertain by a seventh.
    assert state.coverage.span_deg == pytest.approx(true_span, rel=0.15)
    assert not state.coverage.at_least
    seen = np.flatnonzero(state.coverage.bins)
    assert len(seen) == pytest.approx(true_span / 10, abs=1.5)  # a bin begun counts
    assert 2 in state.coverage.bins  # a flash on the way


def test_no_fully_lit_frame_is_shown_as_unlit_nor_the_other_way(walked_film):
    monitor, labels = watch_film(walked_film)
    names = {1: "lit", 0: "unlit", None: "partial"}
    truth = [names[frame.truth.flash] for frame in walked_film.frames]
    pairs = list(zip(truth, labels, strict=True))
    assert ("lit", "unlit") not in pairs
    assert ("unlit", "lit") not in pairs
    # Frames with an edge near their first or last row, and the first ones, may be told otherwise.
    assert np.mean([true == told for true, told in pairs]) > 0.85
    assert monitor.snapshot().pulses_seen == len({f.truth.on_s for f in walked_film.frames} - {None})


def test_a_camera_and_a_head_at_rest_cover_nothing_and_are_still(flat_room):
    monitor = make_monitor()
    for k in range(60):
        monitor.add(flat_room.picture(0.0), k / 30, k)
    state = monitor.snapshot()
    assert state.coverage.span_deg < 1.0  # noise of the corners
    assert state.motion == 0.0


def test_a_head_that_moves_before_a_wall_at_rest_is_told(flat_room):
    monitor = make_monitor(train_period_s=None)
    for k in range(60):
        aside = 12.0 * np.sin(2 * np.pi * k / 60)
        monitor.add(flat_room.picture(0.0, (aside, 0.0)), k / 30, k)
    state = monitor.snapshot()
    assert state.motion > 0.6
    assert state.coverage.span_deg < 3.0
    assert state.advice == "hold still: the head moved"


def test_a_turn_of_everything_is_no_motion_of_the_head(flat_room):
    monitor = make_monitor()
    for k in range(45):
        monitor.add(flat_room.picture(1.5 * k, (1.5 * k - 33, 0.0)), k / 30, k)
    assert monitor.snapshot().motion < 0.3


def test_before_a_bare_wall_the_walk_cannot_be_told(bare_room):
    monitor = make_monitor(train_period_s=None)
    for k in range(150):
        # The head's surface turns against its outline, as in a walk: something moves, but what?
        monitor.add(bare_room.picture(0.0, (6.0 * np.sin(k / 9), 0.0)), k / 30, k)
    state = monitor.snapshot()
    assert state.coverage.span_deg is None
    assert state.coverage.place is None
    assert "cannot be measured" in state.advice


def test_the_wall_walks_by_its_share_of_the_turn(flat_room):
    monitor = make_monitor()
    for k in range(60):
        monitor.add(flat_room.picture(-1.2 * k, (0.2, 0.0)), k / 30, k)
    coverage = monitor.snapshot().coverage
    expected = np.degrees(1.2 * 59 / 280.0) / 0.75
    assert coverage.azimuth_deg < 0  # to the left
    # Corners are found to a tenth of a pixel of 70; the last step of 0.2 s of 2 s may be under way.
    assert coverage.span_deg == pytest.approx(expected, rel=0.1)
    assert coverage.bins[-1] == 1  # it began at the right end
    assert coverage.bins[0] == 0


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_camera_held_sideways_walks_the_same_way(flat_room, turns):
    size = {} if turns == 2 else {"width": 240, "height": 320}
    upright, sideways = make_monitor(), make_monitor(rotation_deg=90 * turns, **size)
    for k in range(40):
        picture = flat_room.picture(1.2 * k)
        upright.add(picture, k / 30, k)
        sideways.add(np.ascontiguousarray(np.rot90(picture, turns)), k / 30, k)
    expected, measured = upright.snapshot(), sideways.snapshot()
    # The same pictures turned back; the small one is made before the turn, which changes roundings only.
    assert measured.coverage.azimuth_deg == pytest.approx(expected.coverage.azimuth_deg, rel=0.03)
    assert measured.level == expected.level


def test_a_flash_does_not_look_like_a_walk(flat_room):
    monitor = make_monitor()
    for k in range(90):
        gain = 1.5 if k % 30 in (20, 21, 22) else 1.0
        monitor.add(flat_room.picture(0.0, gain=gain), k / 30, k)
    state = monitor.snapshot()
    assert state.pulses_seen == 3
    assert state.coverage.span_deg < 1.0
    assert state.motion == 0.0


def test_light_that_stays_on_is_no_flash(flat_room):
    monitor = make_monitor()
    for k in range(120):
        monitor.add(flat_room.picture(0.0, gain=1.0 if k < 30 else 1.5), k / 30, k)
    assert monitor.snapshot().pulses_seen <= 1  # it began like one
    assert set(monitor.snapshot().labels[-30:]) == {"unlit"}


def test_a_recording_that_begins_within_a_flash_finds_its_feet(flat_room):
    monitor = make_monitor()
    labels = [
        monitor.add(flat_room.picture(0.0, gain=1.5 if k % 30 < 4 else 1.0), k / 30, k) for k in range(64)
    ]
    assert set(labels[12:30]) == {"unlit"}
    assert set(labels[30:34]) <= {"lit", "partial"}


def test_a_flash_in_part_of_the_rows_is_partial(flat_room):
    monitor = make_monitor()
    labels = []
    for k in range(75):
        picture = flat_room.picture(0.0).astype(float)
        if k in (20, 21, 22, 51, 52):
            picture *= 1.5
        if k in (50, 53):
            picture[: HEIGHT_PART if k == 53 else None][HEIGHT_PART if k == 50 else 0 :] *= 1.5
        labels.append(monitor.add(np.clip(picture, 0, 255).astype(np.uint8), k / 30, k))
    assert labels[50:54] == ["partial", "lit", "lit", "partial"]


HEIGHT_PART = 120


def test_meters_see_clipping_in_the_subject_after_a_flash(flat_room):
    monitor = make_monitor()
    for k in range(40):
        picture = np.repeat(flat_room.picture(0.0)[..., None], 3, axis=2)
        if k in (30, 31, 32):
            picture = np.clip(picture * 1.4, 0, 240).astype(np.uint8)
            picture[100:140, 140:180, 0] = 255  # one channel is enough
        monitor.add(picture, k / 30, k)
    state = monitor.snapshot()
    # 40 x 40 pixels of the ellipse with half axes 0.28 and 0.38 of 240.
    assert state.clipped_subject == pytest.approx(1600 / (np.pi * 67.2 * 91.2), rel=0.05)
    assert state.clipped == pytest.approx(1600 / (320 * 240), rel=0.05)
    assert state.level_lit > 1.2 * state.level
    assert state.advice == "too bright: lower the exposure"


def test_a_blurred_frame_is_less_sharp(flat_room):
    monitor = make_monitor()
    for k in range(20):
        monitor.add(flat_room.picture(0.0), k / 30, k)
    assert monitor.snapshot().sharpness > 0.8
    monitor.add(cv2.blur(flat_room.picture(0.0), (13, 1)), 20 / 30, 20)
    assert monitor.snapshot().sharpness < 0.6


def test_lost_frames_queue_and_time_are_counted(flat_room):
    monitor = make_monitor(duration_s=2.0)
    for stamp_s, sequence in ((5.0, 7), (5.1, 8), (5.3, 11), (5.3, 12), (7.2, 13)):
        monitor.add(flat_room.picture(0.0), stamp_s, sequence, queue=3)
    state = monitor.snapshot()
    assert (state.frames, state.drops, state.queue) == (5, 2, 3)
    assert state.elapsed_s == pytest.approx(2.2)
    assert state.left_s == 0.0
    assert state.finished


def test_flashes_are_expected_when_the_lamp_says_so(flat_room):
    monitor = make_monitor()
    for k in range(90):
        monitor.add(flat_room.picture(0.0), k / 30, k)
    assert monitor.snapshot().pulses_expected == 2  # periods of a second that have passed
    edges = [FlashEdge(time_s=t, sigma_s=1e-4, on=on, pulse=0) for t in (0.5, 9.0) for on in (True, False)]
    monitor.edges(edges)
    assert monitor.snapshot().pulses_expected == 1  # the other is to come
    assert "flash not seen" in monitor.snapshot().advice


def test_without_a_train_no_flash_is_missed(flat_room):
    monitor = make_monitor(train_period_s=None)
    for k in range(120):
        monitor.add(flat_room.picture(0.0), k / 30, k)
    state = monitor.snapshot()
    assert state.pulses_expected is None
    assert state.advice == "move on around the head"


@pytest.mark.parametrize("shape", [(240, 321), (240, 320, 4, 1)])
def test_a_picture_that_was_not_announced_is_refused(shape):
    with pytest.raises(ValueError, match="was announced"):
        make_monitor().add(np.zeros(shape, np.uint8), 0.0, 0)


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="fps is 0"):
        make_monitor(fps=0)
    with pytest.raises(TransferError):
        make_monitor(transfer="nonsense")


def test_a_state_is_plain_values(flat_room):
    monitor = make_monitor()
    monitor.add(flat_room.picture(0.0), 0.0, 0)
    state = monitor.snapshot()
    assert state.to_json()["coverage"]["bins"] == state.coverage.bins
    with pytest.raises(AttributeError):
        state.level = 1.0
    assert replace(state, level=0.5).level == 0.5
