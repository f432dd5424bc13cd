"""The similarity between two worlds, from the cameras that both have."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.cameras import Camera
from relight.alignment import Similarity, align_cameras, pose_errors
from relight.errors import GeometryError

K = np.array([[500.0, 0, 256], [0, 500.0, 256], [0, 0, 1]])
TO_FOUND = Similarity(
    3.7, Rotation.from_euler("xyz", [40, -110, 200], degrees=True).as_matrix(), np.array([5.0, -2, 9])
)


def looking(centre, target=(0.0, 0.0, 0.0)):
    forward = np.subtract(target, centre)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.01])
    right /= np.linalg.norm(right)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ centre
    return Camera("c", 512, 512, K, cam_from_world)


def half_circle(count=20, height=0.0):
    angles = np.linspace(-1.5, 1.5, count)
    return {k: looking([0.5 * np.sin(a), height, 0.5 * np.cos(a)]) for k, a in enumerate(angles)}


@pytest.mark.parametrize("height", [0.0, 0.2])
def test_a_planar_path_gives_back_the_similarity_and_no_reflection(height):
    true = half_circle(height=height)
    found = {k: TO_FOUND.camera(camera) for k, camera in true.items()}
    back = align_cameras(found, true)
    # Float64, numbers of order ten.
    assert back.scale == pytest.approx(1 / TO_FOUND.scale, rel=1e-10)
    np.testing.assert_allclose(back.rotation, TO_FOUND.rotation.T, atol=1e-9)
    errors = pose_errors(found, true, back)
    assert errors.rotation_deg.max() < 1e-6
    assert errors.centre.max() < 1e-9


def test_cameras_on_a_line_are_turned_by_their_orientations():
    true = {k: looking([0.1 * k - 0.3, 0.0, 0.5], [0.1 * k - 0.3, 0, 0]) for k in range(6)}
    found = {k: TO_FOUND.camera(camera) for k, camera in true.items()}
    errors = pose_errors(found, true, align_cameras(found, true))
    assert errors.rotation_deg.max() < 1e-6
    assert errors.centre.max() < 1e-9


def test_one_wrong_camera_does_not_pull_the_others():
    true = half_circle()
    found = {k: TO_FOUND.camera(camera) for k, camera in true.items()}
    found[7] = TO_FOUND.camera(looking([0.1, 0.4, -0.8]))
    errors = pose_errors(found, true, align_cameras(found, true))
    assert np.delete(errors.centre, 7).max() < 1e-9
    assert errors.centre[7] > 0.5


def test_a_moved_camera_takes_the_same_picture():
    camera = looking([0.2, 0.1, 0.6])
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (5, 3))
    moved, points_moved = TO_FOUND.camera(camera), TO_FOUND.points(points)

    def project(camera, points):
        x = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        return x[:, :2] / x[:, 2:]

    np.testing.assert_allclose(project(moved, points_moved), project(camera, points), atol=1e-12)


def test_too_few_or_coinciding_cameras_are_refused():
    cameras = half_circle(2)
    with pytest.raises(GeometryError, match="2 cameras are known in both worlds"):
        align_cameras(cameras, cameras)
    same = dict.fromkeys(range(5), looking([0.0, 0.0, 0.5]))
    with pytest.raises(GeometryError, match="in one place"):
        align_cameras(same, same)
