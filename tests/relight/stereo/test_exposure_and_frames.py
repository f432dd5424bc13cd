from dataclasses import replace

import numpy as np
import pytest
import torch
from ball_scene import RADIUS, make_session

from relight.stereo.exposure import pair_gain
from relight.stereo.frames import GreyFrames
from relight.stereo.fusion import one_a_cell

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drift") / "s"
    return make_session(folder, [0.0, 4.0, 8.0], flash_every=0, exposures=[1.0, 1.0, 1.5])


def test_a_drift_of_exposure_is_told_from_the_points_that_both_frames_show(drifting):
    session, cameras = drifting
    frames = GreyFrames(session, cameras, CPU, 8)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3)) * [1.0, 1.0, 0.3] + [0.0, 0.0, 2.0]
    points = RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)
    assert pair_gain(frames, 0, 1, points) == pytest.approx(1.0, abs=0.02)
    assert pair_gain(frames, 0, 2, points) == pytest.approx(1.5**-0.45, abs=0.03)  # grey = radiance^0.45


def test_without_points_exposures_are_taken_as_equal(drifting):
    session, cameras = drifting
    frames = GreyFrames(session, cameras, CPU, 8)
    assert pair_gain(frames, 0, 2, np.zeros((0, 3))) == 1.0
    assert pair_gain(frames, 0, 2, np.full((100, 3), 50.0)) == 1.0  # not in the pictures


def test_few_pictures_are_held(drifting):
    session, cameras = drifting
    frames = GreyFrames(session, cameras, CPU, 2)
    for index in cameras:
        for scale in (1.0, 0.5):
            camera = frames.cameras[index].scaled(scale)
            assert frames.grey(index, scale).shape == (camera.height, camera.width)
    assert len(frames._kept) == 2


def test_a_lens_is_undistorted(drifting):
    session, cameras = drifting
    bent = {0: replace(cameras[0], distortion=np.array([0.05, 0.0]))}
    straight = GreyFrames(session, cameras, CPU, 4).grey(0)
    found = GreyFrames(session, bent, CPU, 4)
    assert not found.cameras[0].distortion.any()
    middle = straight.shape[0] // 2
    # The middle stays where it is, the corner does not.
    assert torch.allclose(found.grey(0)[middle, middle], straight[middle, middle], atol=0.02)
    assert not torch.allclose(found.grey(0)[:20, :20], straight[:20, :20], atol=0.02)


def test_a_cube_gets_one_point_with_the_weighted_mean():
    points = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5.0, 5.0, 5.0]])
    normals = torch.tensor([[0.0, 0, 1], [0, 0, 1], [1, 0, 0]])
    merged, directions, member, counts = one_a_cell(points, normals, torch.tensor([1.0, 3.0, 1.0]), 1.0)
    assert counts.tolist() == [2, 1]
    assert member.tolist() == [0, 0, 1]
    assert torch.allclose(merged, torch.tensor([[0.25, 0.1, 0.1], [5.0, 5.0, 5.0]]))
    assert torch.allclose(directions, torch.tensor([[0.0, 0, 1], [1, 0, 0]]))
