import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.cameras import load_posed_set
from capture.images import read_image
from capture.sim import Rig, RigConfig, simulate_posed_set
from capture.sim.camera_path import CameraPath
from capture.sim.head_motion import HeadMotion
from capture.sim.rasterize import project
from capture.sim.shading import environment_diffuse

STANDING = CameraPath(sweep_deg=0.0, sway=0.0, tremor=0.0, duration_s=1.7)


@pytest.fixture(scope="module")
def chair() -> Rig:
    return Rig.build(replace(RigConfig.small(), path=STANDING, motion=HeadMotion(turn_deg=120.0)))


def azimuth_deg(pose: np.ndarray) -> float:
    centre = -pose[:3, :3].T @ pose[:3, 3]
    return float(np.degrees(np.arctan2(centre[0], centre[2])))


def test_who_sits_still_is_where_the_room_was_built_around() -> None:
    assert HeadMotion().still
    for part in (0.0, 0.5, 1.0):
        assert np.allclose(HeadMotion().room_from_head(part), np.eye(4))
    for moving in (
        HeadMotion(turn_deg=1.0),
        HeadMotion(nod_deg=1.0),
        HeadMotion(shift_m=(0, 0.001, 0)),
        HeadMotion(sway_deg=0.1),
        HeadMotion(sway_m=0.001),
    ):
        assert not moving.still


def test_every_pose_is_rigid() -> None:
    motion = HeadMotion(turn_deg=150.0, nod_deg=3.0, shift_m=(0.004, 0.0, -0.002), sway_deg=2.0, sway_m=0.003)
    for part in np.linspace(0.0, 1.0, 11):
        pose = motion.room_from_head(part)
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert pose[3].tolist() == [0, 0, 0, 1]


def test_a_nod_happens_once_in_the_middle_and_stays() -> None:
    motion = HeadMotion(nod_deg=4.0, shift_m=(0.003, 0.0, 0.0))
    assert np.allclose(motion.room_from_head(0.48), np.eye(4))
    after = motion.room_from_head(0.52)
    assert np.allclose(after, motion.room_from_head(1.0))
    nose = np.array([0.0, 0.0, 0.1, 1.0])
    moved = after @ nose - nose
    assert moved[1] < -0.005  # 10 cm before the neck, by 4 degrees: down by 7 mm or more
    assert moved[0] == pytest.approx(0.003)
    turn = np.degrees(np.arccos((np.trace(after[:3, :3]) - 1) / 2))
    assert turn == pytest.approx(4.0)


def test_swaying_is_slow_and_small() -> None:
    motion = HeadMotion(sway_deg=1.0, sway_m=0.004, seed=3)
    poses = np.array([motion.room_from_head(part) for part in np.linspace(0, 1, 481)])  # 30 Hz over 16 s
    steps = np.abs(np.diff(poses[:, :3, 3], axis=0))
    # Two sines of unit size over sqrt(2) each at most 0.23 Hz, and the neck's arm of 12 cm.
    assert steps.max() < (0.004 + np.radians(1.0) * 0.12) * np.sqrt(2) * 2 * np.pi * 0.23 / 30 * 1.1
    assert np.ptp(poses[:, :3, 3], axis=0).min() > 0.003


def test_to_a_standing_camera_a_turning_chair_is_a_walk_around_the_head(chair: Rig) -> None:
    times = np.array([0.0, 0.425, 0.85, 1.275, 1.7])
    azimuths = [azimuth_deg(chair.camera(t, "x").cam_from_world) for t in times]
    assert azimuths == pytest.approx([-60, -30, 0, 30, 60], abs=0.01)


def test_the_head_turns_and_the_room_stands_still(chair: Rig) -> None:
    pictures, masks = [], []
    for time_s in (0.2, 1.5):
        layers = chair.layers(chair.camera(time_s, "x"), True, chair.room_from_head(time_s))
        pictures.append(layers.room)
        masks.append(layers.coverage)
    background = (masks[0] == 0) & (masks[1] == 0)
    # Away from the head, and from its outline, over which the room's defocus mixes nothing.
    assert background.mean() > 0.1
    assert np.abs(pictures[0] - pictures[1])[background].max() < 1e-5
    head = (masks[0] == 1) & (masks[1] == 1)
    assert np.abs(pictures[0] - pictures[1])[head].mean() > 0.02


def test_the_rooms_light_on_a_turned_head_comes_from_where_it_did(chair: Rig) -> None:
    mains = []
    for time_s in (0.0, 0.85, 1.7):
        turned = chair.room_from_head(time_s)
        assert turned is not None
        passed = chair._passed_at(turned)
        light = environment_diffuse(chair.bust, chair.room_light, passed, turned[:3, :3]) / chair.bust.albedo
        main = light.mean(axis=1) @ chair.bust.normals
        mains.append(turned[:3, :3] @ (main / np.linalg.norm(main)))
    # The bust's own normals are not even over the sphere and turn with it, which bends the sum somewhat;
    # light that turned with the head would be 60 and 120 degrees off.
    for other in mains[1:]:
        assert np.degrees(np.arccos(mains[0] @ other)) < 25


def test_the_poses_on_disk_are_those_of_the_head(chair: Rig, tmp_path: Path) -> None:
    config = replace(chair.config, posed_frames=6)
    posed = load_posed_set(simulate_posed_set(tmp_path, config, rig=replace(chair, config=config)))
    for frame in posed.frames:
        assert frame.mask is not None
        # Points of the sitter fall on the mask, in the head's axes, in every frame.
        pixel, _ = project(frame.camera, chair.bust.vertices[:: len(chair.bust.vertices) // 300])
        inside = ((pixel > 3) & (pixel < [frame.camera.width - 3, frame.camera.height - 3])).all(axis=1)
        mask = cv2.dilate(read_image(frame.mask), np.ones((3, 3)))
        at = np.floor(pixel[inside]).astype(int)
        assert (mask[at[:, 1], at[:, 0]] > 0).mean() > 0.97  # loose strands are thinner than a pixel
    assert "moves with the head" in json.loads((tmp_path / "cameras.json").read_text())["world"]


def test_motions_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="nod_deg 90"):
        HeadMotion(nod_deg=90.0)
    with pytest.raises(ValueError, match="turn_deg nan"):
        HeadMotion(turn_deg=float("nan"))
