from dataclasses import replace

import numpy as np
import pytest

from capture.sim import Rig, RigConfig, Subject
from capture.sim.camera_path import CameraPath
from capture.sim.environment import look_up
from capture.sim.sensor import SensorConfig
from capture.sim.subject import HAIR_STYLES


def with_sensor(rig: Rig, **settings: float) -> Rig:
    return replace(rig, config=replace(rig.config, sensor=replace(rig.config.sensor, **settings)))


def test_a_frame_is_the_room_plus_the_lit_fraction_of_the_flash(small_rig: Rig) -> None:
    rig = with_sensor(small_rig, noise=False)
    kinds = set()
    for frame in rig.frames():
        if frame.truth.flash in kinds:
            continue
        kinds.add(frame.truth.flash)
        layers = rig.layers(frame.camera, flash=True)
        assert layers.flash is not None
        expected = rig.config.sensor.encode(layers.room + frame.lit[:, None, None] * layers.flash)
        # The analogue-digital steps are finer than the codes everywhere but at the black end of the curve.
        assert np.abs(frame.rgb.astype(int) - expected).max() <= 2
    assert kinds == {0, 1, None}


def test_flags_follow_from_the_rows_light(small_rig: Rig) -> None:
    for frame in small_rig.frames():
        truth = frame.truth
        assert truth.lit_min == frame.lit.min()
        assert truth.lit_max == frame.lit.max()
        assert truth.lit_fraction == pytest.approx(frame.lit.mean())
        assert (truth.on_s is not None) == (frame.lit.max() > 0)
        assert truth.flash == (1 if truth.lit_min > 0.97 else 0 if truth.lit_max <= 0.02 else None)


def test_the_flash_lights_the_head_more_than_the_room_behind_it(small_rig: Rig) -> None:
    layers = small_rig.layers(small_rig.camera(0.85, "x"), flash=True)
    assert layers.flash is not None
    head, behind = layers.coverage == 1, layers.coverage == 0
    ratio = layers.flash.mean(-1) / layers.room.mean(-1)
    assert np.median(ratio[head]) > 0.7
    assert np.median(ratio[head]) > 4 * np.median(ratio[behind])


def test_an_upright_surface_facing_the_front_receives_the_configured_light(small_rig: Rig) -> None:
    received = look_up(small_rig.room_light.diffuse, np.array([[0, 0, 1]], np.float32)).mean()
    assert received == pytest.approx(small_rig.config.room_level, rel=0.01)  # bilinear look-up


def test_lost_frames_are_told_and_leave_gaps_in_the_stamps(small_rig: Rig) -> None:
    rig = with_sensor(small_rig, dropped=0.2, seed=3)
    truths = [frame.truth for frame in rig.frames()]
    ticks = round(rig.config.path.duration_s * rig.config.fps)
    lost = sum(truth.dropped_before for truth in truths)
    assert [truth.index for truth in truths] == list(range(len(truths)))
    assert 0 <= ticks - len(truths) - lost <= 3  # those lost at the very end are before no frame
    assert lost > 3
    gaps = np.diff([truth.pts_s for truth in truths]) * rig.config.fps
    expected = [1 + truth.dropped_before for truth in truths[1:]]
    assert np.abs(gaps - expected).max() < 0.1  # 0.4 ms of jitter on two stamps, 4 sigma each


def test_the_same_configuration_gives_the_same_frames(small_rig: Rig) -> None:
    again = Rig.build(RigConfig.small())
    for first, second in zip(small_rig.frames(), again.frames(), strict=True):
        assert np.array_equal(first.rgb, second.rgb)
        assert first.truth == second.truth
        if first.truth.index == 12:  # past the first pulse
            break


def test_exposure_drift_brightens_the_end_of_the_recording(small_rig: Rig) -> None:
    steady, drifting = (
        with_sensor(small_rig, noise=False),
        with_sensor(small_rig, noise=False, exposure_drift=0.2),
    )
    *_, last = steady.frames()
    *_, brighter = drifting.frames()
    first, same = next(steady.frames()), next(drifting.frames())
    assert np.abs(first.rgb.astype(int) - same.rgb).max() <= 1
    assert brighter.rgb.mean() > 1.05 * last.rgb.mean()


def test_a_turned_sensor_stores_the_turned_picture(small_rig: Rig) -> None:
    pose = small_rig.config.path.cam_from_world(1.0)
    upright = small_rig.layers(small_rig.camera_at(pose, "x"), flash=False).room
    for turn in (90, 180, 270):
        turned_rig = replace(small_rig, config=replace(small_rig.config, rotation_deg=turn))
        stored = turned_rig.layers(turned_rig.camera_at(pose, "x"), flash=False).room
        # Clockwise by the recorded angle gives the upright picture; samples on outlines may fall differently.
        difference = np.abs(np.rot90(stored, -turn // 90) - upright)
        assert np.median(difference) < 1e-4
        assert np.mean(difference) < 2e-3


def test_the_hand_moves_smoothly_half_around_the_head() -> None:
    path = CameraPath(duration_s=16.0)
    poses = [path.cam_from_world(t) for t in np.arange(0, 16, 1 / 30)]
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    azimuth = np.degrees(np.arctan2(centres[:, 0], centres[:, 2]))
    assert azimuth[0] < -75
    assert azimuth[-1] > 75
    assert np.linalg.norm(centres, axis=-1).min() > 0.5
    assert np.linalg.norm(np.diff(centres, axis=0), axis=-1).max() < 0.015  # below half a metre a second
    assert all(np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) for pose in poses[::60])


def test_a_path_without_sway_and_tremor_is_an_exact_arc_and_may_be_two_centimetres_long() -> None:
    path = CameraPath(sweep_deg=2.0, sway=0.0, tremor=0.0, elevation_deg=0.0)
    centres = np.array([-p[:3, :3].T @ p[:3, 3] for p in map(path.cam_from_world, np.linspace(0, 16, 33))])
    assert np.linalg.norm(centres - np.array(path.target), axis=1) == pytest.approx([0.58] * 33)
    assert np.linalg.norm(centres[-1] - centres[0]) == pytest.approx(0.02, abs=0.001)


def test_seeds_give_different_people_within_measured_reflectances() -> None:
    people = [Subject.from_seed(seed) for seed in range(30)]
    assert len(set(people)) == 30
    assert {person.hair_style for person in people} == set(HAIR_STYLES)
    for person in people:
        assert person.skin[0] > person.skin[1] > person.skin[2]
        assert 0.1 < person.skin[0] < 0.6


def test_impossible_rigs_are_refused() -> None:
    with pytest.raises(ValueError, match="rotation_deg 45"):
        RigConfig(rotation_deg=45)
    with pytest.raises(ValueError, match="flash_every -1"):
        RigConfig(flash_every=-1)
    with pytest.raises(ValueError, match="even"):
        RigConfig(width=481)
    with pytest.raises(ValueError, match="mohawk"):
        Subject(hair_style="mohawk")
    with pytest.raises(ValueError, match="dropped"):
        SensorConfig(dropped=1.0)
