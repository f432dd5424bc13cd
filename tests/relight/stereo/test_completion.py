import numpy as np
import pytest
import torch
from ball_scene import RADIUS, make_session

from relight.head_region import HeadRegion
from relight.stereo import DenseCloud, complete_with_masks
from relight.stereo.completion import completed
from relight.stereo.frames import GreyFrames
from relight.stereo.hull import visual_hull

REGION = HeadRegion(np.zeros(3), 0.14, "test")


def ball_points(count, azimuth_deg):
    """Points of the ball seen from the front, up to an azimuth, 3 mm apart."""
    turn = np.arange(count) * 2.399963
    y = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    flat = np.sqrt(1.0 - y * y)
    points = RADIUS * np.stack([flat * np.sin(turn), y, flat * np.cos(turn)], axis=1)
    azimuth = np.degrees(np.arctan2(points[:, 0], points[:, 2]))
    points = points[np.abs(azimuth) < azimuth_deg].astype(np.float32)
    return DenseCloud(points, (points / RADIUS).astype(np.float32), np.ones(len(points), np.float32))


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    azimuths = [float(x) for x in np.linspace(-80, 80, 13)]
    return make_session(tmp_path_factory.mktemp("masked") / "s", azimuths, masks=True)


def test_the_outlines_complete_what_stereo_did_not_see(masked):
    session, cameras = masked
    cloud = ball_points(12_000, 70.0)
    whole = complete_with_masks(session, cameras, cloud, REGION)
    added = whole.points[len(cloud.points) :]
    assert whole.report["from_masks"] == len(added) > 500
    azimuth = np.abs(np.degrees(np.arctan2(added[:, 0], added[:, 2])))
    assert ((azimuth > 90) & (azimuth < 150)).any()
    beside = np.abs(added[:, 1]) < 0.05
    # A pixel is 4 mm here; farther up the hull of cameras at one height stands off the ball.
    assert np.median(np.abs(np.linalg.norm(added[beside], axis=1) - RADIUS)) < 0.003
    assert (whole.confidence[len(cloud.points) :] == 0).all()
    facing = (whole.normals_world * whole.points).sum(axis=1) / np.linalg.norm(whole.points, axis=1)
    assert np.percentile(facing, 5) > 0.8


def test_a_hollow_that_stereo_saw_is_not_bridged(masked):
    session, cameras = masked
    cloud = ball_points(12_000, 180.0)
    front = cloud.points[:, 2] > 0.85 * RADIUS
    hollow = cloud.points.copy()
    hollow[front, 2] -= 0.03
    frames = GreyFrames(session, cameras, torch.device("cpu"), 1)
    hull = visual_hull(frames, REGION)
    assert hull is not None
    dented = DenseCloud(hollow, cloud.normals_world, cloud.confidence)
    added = completed(dented, hull, frames).points[len(hollow) :]
    over = (np.linalg.norm(added[:, :2], axis=1) < 0.03) & (added[:, 2] > 0)
    assert not over.any()


def test_without_masks_nothing_is_added(tmp_path):
    session, cameras = make_session(tmp_path / "s", [-20.0, 0.0, 20.0])
    cloud = ball_points(3_000, 60.0)
    assert complete_with_masks(session, cameras, cloud, REGION) is cloud
