"""From pictures of a session to poses: a textured ball before a papered wall, ray-cast here."""

import json

import cv2
import numpy as np
import pytest

from capture.images import write_exr
from capture.session import FrameRecord, Session
from relight.alignment import align_cameras, pose_errors
from relight.errors import GeometryError
from relight.sfm import SfmConfig, find_poses


def noise(seed, size=1024):
    """[size, size] albedo with detail at several scales."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(size, size)), (0, 0), s) * s for s in (1.5, 4.0, 12.0)]
    return (0.3 * np.exp(0.8 * sum(layers))).clip(0.02, 0.9).astype(np.float32)


BALL, WALL = noise(0), noise(1)


def photograph(camera, flash):
    """Linear radiance [H, W, 3]: room light on all, and on a lit frame the flash beside the lens."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = camera.centre_world
    b = rays @ eye
    root = b * b - (eye @ eye - 0.12**2)
    on_ball = root > 0
    far = (-0.5 - eye[2]) / np.minimum(rays[..., 2], -1e-3)
    distance = np.where(on_ball, -b - np.sqrt(np.maximum(root, 0)), far)
    x = eye + distance[..., None] * rays
    lengthwise = np.arctan2(x[..., 0], x[..., 2]) * 160 + 512
    upright = np.arcsin(np.clip(x[..., 1] / 0.12, -1, 1)) * 160 + 512
    places = np.where(on_ball[..., None], np.stack([lengthwise, upright], -1), 512 + 420 * x[..., :2])
    places = places.astype(np.float32)
    albedo = [
        cv2.remap(t, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for t in (BALL, WALL)
    ]
    albedo = np.where(on_ball, *albedo)
    facing = np.where(on_ball, -(rays * x / 0.12).sum(-1), 0.9)
    radiance = albedo * (0.5 + flash * 0.12 * facing.clip(0) / distance**2)
    return np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)


@pytest.fixture
def session_of(tmp_path):
    """Makes a session of linear frames."""

    def make(frames, flashes):
        height, width = frames[0].shape[:2]
        with Session.create(
            tmp_path / "session", source={"kind": "test"}, width=width, height=height
        ) as session:
            for k, (frame, flash) in enumerate(zip(frames, flashes, strict=True)):
                name = f"frames/{k:06d}.exr"
                write_exr(session.path / name, frame)
                session.append_frame(FrameRecord(index=k, file=name, width=width, height=height, flash=flash))
        return Session.open(tmp_path / "session")

    return make


def test_lit_and_unlit_frames_are_posed_together(session_of, make_arc):
    cameras = make_arc(9, -20, 20)
    frames = [photograph(camera, camera.flash) for camera in cameras]
    frames.append(np.full_like(frames[0], np.nan))
    frames[3][50:90, 60:120] = np.nan
    session = session_of(frames, [camera.flash for camera in cameras] + [0])
    told = []
    result = find_poses(
        session, session.frames, SfmConfig(threads=1, max_features=800), lambda *a: told.append(a)
    )
    assert sorted(result.cameras) == list(range(9))
    assert "not finite" in result.report["without_pose"]["9"]
    true = dict(enumerate(cameras))
    found = pose_errors(result.cameras, true, align_cameras(result.cameras, true))
    # A few hundred features of a quarter of a pixel on an arc of 40 degrees, with a lens that was guessed.
    assert np.median(found.rotation_deg) < 0.3
    assert np.median(found.centre) < 0.006
    assert [result.cameras[k].flash for k in range(9)] == [camera.flash for camera in cameras]
    assert result.colors.shape == result.points_world.shape
    assert 0.02 < np.median(result.colors) < 0.6
    assert told[-1] == ("poses", 1.0)
    json.dumps(result.report)


def test_frames_of_nothing_are_refused_in_a_sentence(session_of):
    flat = [np.full((120, 160, 3), 0.3, np.float32) for _ in range(4)]
    session = session_of(flat, [0, 1, 0, 0])
    with pytest.raises(GeometryError, match="markers"):
        find_poses(session, session.frames, SfmConfig(threads=1))


def test_frames_that_cannot_be_read_are_refused(session_of):
    session = session_of([np.full((60, 80, 3), np.nan, np.float32)] * 3, [0, 0, 0])
    with pytest.raises(GeometryError, match="0 of 3 frames can be read"):
        find_poses(session, session.frames, SfmConfig(threads=1))
