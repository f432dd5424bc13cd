import numpy as np
import torch
from ball_scene import RADIUS, make_session

from relight.head_region import HeadRegion
from relight.stereo.frames import GreyFrames
from relight.stereo.hull import visual_hull

REGION = HeadRegion(np.zeros(3), 0.15, "test")


def test_the_hull_of_a_balls_masks_is_the_ball_where_cameras_looked(tmp_path):
    azimuths = [float(x) for x in np.linspace(-170, 180, 12)]
    session, cameras = make_session(tmp_path / "s", azimuths, masks=True)
    found = visual_hull(GreyFrames(session, cameras, torch.device("cpu"), 4), REGION)
    assert found is not None
    points, normals, masks = found.points, found.normals_world, found.masks
    assert masks == 12
    distance = np.linalg.norm(points, axis=1)
    about_equator = np.abs(points[:, 1]) < 0.03
    # Boxes of 2.7 mm, smoothed over three; pixels of 4 mm.
    assert np.abs(distance[about_equator] - RADIUS).mean() < 0.004
    outward = (points / distance[:, None] * normals).sum(axis=1)
    assert outward[about_equator].mean() > 0.95


def test_too_few_masks_make_no_hull(tmp_path):
    session, cameras = make_session(tmp_path / "s", [0.0, 10.0, 20.0], masks=True)
    assert visual_hull(GreyFrames(session, cameras, torch.device("cpu"), 4), REGION) is None
