"""The world's frame, and the checks that a wrong reconstruction fails."""

from dataclasses import replace

import numpy as np
import pytest

from relight.sfm.attempts import match_pairs
from relight.sfm.checks import assess, pair_agreement, path_jumps, sampson_distance
from relight.sfm.lenses import Lens, colmap_camera
from relight.sfm.matching import Pair
from relight.sfm.resection import resect_all
from relight.sfm.sparse import Sparse
from relight.sfm.world import TYPICAL_DISTANCE, canonical_world, look_point


@pytest.fixture
def known(scene, make_arc):
    """The truth as a reconstruction: looks, cameras, points by nearest descriptor."""
    cameras = make_arc(10)
    points = scene(head_points=120, room_points=200)
    looks = points.looks(cameras)
    world = np.concatenate([points.head, points.room])
    descriptors = points.descriptors.astype(np.float32)
    rows = []
    for k, look in enumerate(looks):
        which = (look.features.descriptors.astype(np.float32) @ descriptors.T).argmax(axis=1)
        rows += [(k, feature, point) for feature, point in enumerate(which)]
    observations = np.array(sorted(rows, key=lambda row: row[2]))
    sparse = Sparse(dict(enumerate(cameras)), world, np.full(len(world), 0.2), observations, "PINHOLE")
    pairs = match_pairs(looks, [(i, i + 1) for i in range(9)], 1, lambda share: None)
    return looks, cameras, sparse, pairs


def all_inliers(pair):
    class Everything:
        inlier_matches = pair.matches
        config = 2

    return Pair(pair.first, pair.second, pair.matches, Everything())


def test_the_truth_passes_the_checks(known):
    looks, _, sparse, pairs = known
    assessment = assess(sparse, looks, [all_inliers(pair) for pair in pairs])
    assert assessment.complaints == ()
    assert assessment.jumps == ()
    assert assessment.numbers["fan_deg"] == pytest.approx(100, abs=2)


def test_poses_that_contradict_the_pairs_are_complained_of(known):
    looks, cameras, sparse, pairs = known
    pairs = [all_inliers(pair) for pair in pairs]
    mirrored = replace(sparse, cameras={k: cameras[9 - k] for k in range(10)})
    assert pair_agreement(sparse, looks, pairs) == 1
    assert pair_agreement(mirrored, looks, pairs) < 0.3
    assert assess(mirrored, looks, pairs).complaints


def test_a_frame_beside_the_path_is_found(known):
    _, cameras, sparse, _ = known
    astray = cameras[4].cam_from_world.copy()
    astray[:3, 3] += [0.3, 0.1, 0]
    off = replace(sparse, cameras=sparse.cameras | {4: replace(cameras[4], cam_from_world=astray)})
    assert path_jumps(sparse) == []
    assert path_jumps(off) == [4]
    assert 4 not in sparse.without([4]).cameras
    assert sparse.without([4]).track_length.min() >= 2


def test_little_parallax_is_complained_of(known, make_arc):
    looks, _, sparse, pairs = known
    narrow = replace(sparse, cameras=dict(enumerate(make_arc(10, -0.3, 0.3))))
    assessment = assess(narrow, looks, pairs)
    assert not assessment.parallax
    assert any("parallax" in complaint for complaint in assessment.complaints)


def test_an_empty_reconstruction_is_complained_of(known):
    looks, _, sparse, _ = known
    empty = replace(
        sparse, points=np.zeros((0, 3)), error_px=np.zeros(0), observations=np.zeros((0, 3), np.int64)
    )
    assert "0 points" in assess(empty, looks, []).complaints[0]


def test_sampson_distance_is_that_of_a_shifted_point():
    pose = np.eye(4)
    pose[0, 3] = 0.3  # sideways: epipolar lines are rows
    first = np.array([[0.1, 0.2], [0.0, 0.0]])
    second = first + np.array([[0.05, 0.0], [0.05, 0.01]])
    # Half of the shift on either side: 0.01 / sqrt(2).
    assert sampson_distance(first, second, pose) == pytest.approx([0, 0.01 / np.sqrt(2)], abs=1e-9)


def test_frames_that_were_left_out_get_their_pose(known):
    looks, cameras, sparse, _ = known
    lens = Lens(400, 300, cameras[0].K, np.zeros(0), True, "test")
    others = sparse.without([3])
    kept = list(range(10))
    found, failed = resect_all(
        looks, kept, others, {(400, 300): colmap_camera(lens, (400, 300), False, 1)}, 0
    )
    assert failed == {}
    assert list(found) == [3]
    # Sixty points of 0.15 px, the head at half a metre.
    assert np.linalg.norm(found[3].centre_world - cameras[3].centre_world) < 0.004
    assert found[3].flash == looks[3].record.flash


def test_a_frame_that_shares_nothing_is_not_posed(known, scene):
    looks, cameras, sparse, _ = known
    looks = [*looks[:3], scene(seed=7).look(cameras[3], 3), *looks[4:]]
    lens = Lens(400, 300, cameras[0].K, np.zeros(0), True, "test")
    camera = colmap_camera(lens, (400, 300), False, 1)
    found, failed = resect_all(looks, list(range(10)), sparse.without([3]), {(400, 300): camera}, 0)
    assert found == {}
    assert "points" in failed[3]


def turned_sensor(cameras, quarter_turns):
    """The same cameras held so that their pictures must be turned clockwise to be upright."""
    turn = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    step = np.linalg.matrix_power(turn, quarter_turns)
    return [replace(camera, cam_from_world=step @ camera.cam_from_world) for camera in cameras]


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_up_is_that_of_the_upright_pictures(make_arc, rotation_deg):
    cameras = turned_sensor(make_arc(9), rotation_deg // 90)
    world = canonical_world(cameras, np.zeros((1, 3)), rotation_deg, 1.0)
    assert world.rotation @ [0, 1, 0] == pytest.approx([0, 1, 0], abs=0.02)  # the hand's tilt
    assert np.linalg.det(world.rotation) == pytest.approx(1)
    assert world.points(np.zeros((1, 3)))[0] == pytest.approx([0, 0, 0], abs=0.01)
    assert world.scale == 1.0


def test_a_walk_all_around_has_a_front_too(make_arc):
    world = canonical_world(make_arc(36, -180, 170), np.zeros((1, 3)), 0, None)
    assert np.isfinite(world.rotation).all()
    assert np.linalg.det(world.rotation) == pytest.approx(1)
    assert world.scale * 0.55 == pytest.approx(TYPICAL_DISTANCE, rel=0.02)


def test_parallel_axes_meet_at_the_points():
    centres = np.array([[x, 0.0, 0.0] for x in (-0.1, 0.0, 0.1)])
    axes = np.tile([0.0, 0, 1], (3, 1))
    points = np.array([[0.0, 0, 0.4], [0.1, 0, 0.5], [0, 0.1, 0.6]])
    assert look_point(centres, axes, points) == pytest.approx([0, 0, 0.5])
