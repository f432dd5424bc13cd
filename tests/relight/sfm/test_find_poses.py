"""Poses from features whose truth is known, with noise of a sixth of a pixel."""

import json
from dataclasses import replace

import numpy as np
import pytest

from relight.alignment import align_cameras, pose_errors
from relight.errors import GeometryError
from relight.sfm.features import Features


def errors(result, cameras):
    true = {index: cameras[index] for index in result.cameras}
    found = pose_errors(result.cameras, true, align_cameras(result.cameras, true))
    return found.rotation_deg, found.centre / 0.55


def test_all_frames_get_their_pose_with_a_known_lens(scene, make_arc, found_from):
    cameras = make_arc(14)
    result = found_from(scene().looks(cameras))
    rotation_deg, centre = errors(result, cameras)
    assert sorted(result.cameras) == list(range(14))
    # 0.15 px of 420 is 0.02 degrees a feature; the common part comes from aligning by the centres alone.
    assert np.median(rotation_deg) < 0.05
    assert rotation_deg.max() < 0.08
    assert np.median(centre) < 0.001
    assert result.report["lens_model"] == "PINHOLE"
    # Two coordinates of 0.15 px, less what the points themselves take up of it.
    assert 0.1 < np.median(result.error_px) < 0.25
    assert result.track_length.min() >= 2
    json.dumps(result.report)
    assert result.warnings == ()


def test_the_focal_length_is_found_when_nothing_is_known(scene, make_arc, found_from):
    cameras = make_arc(14)
    result = found_from(scene().looks(cameras), calibrated=False)
    rotation_deg, centre = errors(result, cameras)
    # The guess is 1.1 x 400 = 440 px, 5 % off; half a percent is what two thousand observations must find.
    assert result.cameras[0].K[0, 0] == pytest.approx(420.0, rel=0.005)
    assert result.cameras[0].distortion.size == 0
    assert np.median(rotation_deg) < 0.05
    assert np.median(centre) < 0.003


def test_the_same_frames_give_the_same_poses(scene, make_arc, found_from):
    looks = scene(head_points=150, room_points=250).looks(make_arc(8))
    first, second = found_from(looks), found_from(looks)
    for index, camera in first.cameras.items():
        assert np.array_equal(camera.cam_from_world, second.cameras[index].cam_from_world)


def test_the_world_has_up_front_and_the_agreed_size(scene, make_arc, found_from):
    cameras = make_arc(12)
    result = found_from(scene().looks(cameras))
    centres = np.array([camera.centre_world for camera in result.cameras.values()])
    ups = np.array([-camera.cam_from_world[1, :3] for camera in result.cameras.values()])
    assert not result.metric
    assert "0.55" in result.scale_source
    assert np.median(np.linalg.norm(centres, axis=1)) == pytest.approx(0.55, rel=1e-6)
    assert ups.mean(axis=0)[[0, 2]] == pytest.approx([0, 0], abs=1e-6)
    assert centres[:, 2].min() > 0  # +Z is the side from which they look
    assert abs(centres.mean(axis=0)[0]) < 0.02  # the arc is symmetric about its middle


def test_blurred_frames_are_posed_from_the_others(scene, make_arc, found_from):
    cameras = make_arc(14)
    points = scene()
    looks = points.looks(cameras)
    looks[5] = points.look(cameras[5], 5, flash=0, sharpness=0.1)
    result = found_from(looks)
    rotation_deg, _ = errors(result, cameras)
    assert result.report["left_out"] == {"5": "blurred"}
    assert result.report["resected"] == 1
    assert rotation_deg[5] < 0.08  # its own two hundred features, without the adjustment of all


def test_frames_that_fit_nothing_are_reported(scene, make_arc, found_from):
    cameras = make_arc(14)
    looks = scene().looks(cameras)
    looks[6] = scene(seed=9).look(cameras[6], 6)  # of another room and another head
    result = found_from(looks, refused={14: "it has no picture"})
    assert sorted(result.cameras) == [*range(6), *range(7, 14)]
    assert set(result.report["without_pose"]) == {"6", "14"}
    assert "2 of 15" in result.warnings[-1]


def test_too_few_frames_are_refused(scene, make_arc, found_from):
    with pytest.raises(GeometryError, match="2 frames are too few"):
        found_from(scene().looks(make_arc(2)))


def test_frames_from_one_place_are_refused(scene, make_arc, found_from):
    camera = make_arc(1)[0]
    looks = [scene().look(camera, k) for k in range(5)]
    with pytest.raises(GeometryError, match="same view"):
        found_from(looks)


def test_a_camera_that_turns_on_the_spot_is_refused(scene, make_camera, found_from):
    cameras = [make_camera([0, 0, 0.55], [0.25 * k / 6 - 0.125, 0, 0], index=k) for k in range(7)]
    with pytest.raises(GeometryError, match="walk around the head"):
        found_from(scene().looks(cameras))


def test_two_rooms_are_refused_as_pieces(scene, make_arc, found_from):
    cameras = make_arc(16)
    looks = scene().looks(cameras)[:8] + scene(seed=5).looks(cameras)[8:]
    with pytest.raises(GeometryError, match=r"8 of 16|pieces"):
        found_from(looks)


def test_printed_markers_of_known_size_give_the_metre(scene, make_arc, found_from):
    cameras = make_arc(10)
    one = np.array([[x, y - 0.14, 0.05] for x, y in MARKER])
    corners = [one + np.array([0.06 * k, 0.0, 0.0]) for k in range(-1, 2)]
    looks = [
        with_corners(look, cameras[k], np.concatenate(corners))
        for k, look in enumerate(scene().looks(cameras))
    ]
    result = found_from(looks, marker_side_m=0.03)
    centres = np.array([camera.centre_world for camera in result.cameras.values()])
    truth = np.array([camera.centre_world for camera in cameras])
    assert result.metric
    assert "30 mm" in result.scale_source
    # Corners of 0.1 px on sides of 22 px, twelve sides, each corner in ten frames.
    found, true = (
        np.linalg.norm(np.diff(centres, axis=0), axis=1),
        np.linalg.norm(np.diff(truth, axis=0), axis=1),
    )
    assert np.median(found / true) == pytest.approx(1.0, abs=0.005)


MARKER = 0.03 * np.array([[0, 1], [1, 1], [1, 0], [0, 0]])


def with_corners(look, camera, corners):
    """The look with the corners of printed markers [4 M, 3] that the camera sees."""
    cam = corners @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    places = cam[:, :2] / cam[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]
    places += 0.1 * np.random.default_rng(look.index).normal(size=places.shape)
    features = look.features
    more = Features(
        np.concatenate([features.places_px, places]),
        features.descriptors,
        np.concatenate([features.labels, np.arange(len(corners))]),
        np.concatenate([features.colors, np.zeros((len(corners), 3), np.float32)]),
    )
    return replace(look, features=more)


def turned(angle_deg):
    a = np.radians(angle_deg)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def test_a_head_that_turns_before_a_still_camera_is_posed_by_what_moves(scene, make_camera, found_from):
    camera = make_camera([0, 0, 0.55])
    points = scene(head_points=500, room_points=400)
    angles = np.linspace(-30, 30, 14)
    looks = [points.look(camera, k, head_turn=turned(angle)) for k, angle in enumerate(angles)]
    result = found_from(looks)
    steps = [
        result.cameras[k + 1].cam_from_world[:3, :3] @ result.cameras[k].cam_from_world[:3, :3].T
        for k in range(13)
    ]
    found_deg = [np.degrees(np.arccos((np.trace(step) - 1) / 2)) for step in steps]
    assert found_deg == pytest.approx(np.full(13, 60 / 13), abs=0.15)  # a head of 80 pixels' radius
    assert "stands still" in result.warnings[0]


def test_a_head_that_turns_against_the_room_is_posed_by_itself(scene, make_arc, found_from):
    cameras = make_arc(14)
    points = scene(head_points=500, room_points=300, subject_known=True)
    looks = [
        points.look(camera, k, room_turn=turned(4.0 * k), flash=camera.flash)
        for k, camera in enumerate(cameras)
    ]
    result = found_from(looks)
    rotation_deg, _ = errors(result, cameras)
    assert np.median(rotation_deg) < 0.2  # the head alone, a quarter of the picture
    assert result.warnings


def test_the_background_can_be_ignored_only_where_something_tells_it(scene, make_arc, found_from):
    looks = scene().looks(make_arc(6))
    with pytest.raises(GeometryError, match="background"):
        found_from(looks, background="ignore")
