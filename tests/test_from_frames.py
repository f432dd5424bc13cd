"""Nothing given but pictures: poses, cloud, masks and metres are found, and the portrait is a good one."""

import json
from dataclasses import replace

import numpy as np
import pytest

from capture.session import Session
from capture.sim import RigConfig, simulate_posed_set
from relight.cli import main
from relight.geometry_plan import candidates
from relight.stage_cache import StageCache

# The smallest pictures in which stereo still has something to see: a head is 150 pixels wide.
CONFIG = replace(
    RigConfig.from_seed(3),
    width=240,
    height=320,
    focal_px=345.0,
    posed_frames=32,
    cell_mm=4.0,
    subdivisions=0,
    strands=1500,
    shadow_directions=16,
    cloud_points=10_000,
    validation_views=2,
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """The rig's pictures with all that is true of them."""
    folder = tmp_path_factory.mktemp("rig")
    simulate_posed_set(folder, CONFIG)
    return folder


@pytest.fixture(scope="module")
def session(truth, tmp_path_factory):
    """A session of the pictures and their flash flags alone, fitted."""
    path = tmp_path_factory.mktemp("work") / "S"
    assert main(["import", str(truth), "--without", "poses,points,masks", "--out", str(path)]) == 0
    assert main(["fit", str(path), "--device", "cpu"]) == 0
    return path


def test_poses_and_portrait_are_as_true_as_small_pictures_allow(session, truth, tmp_path):
    assert main(["evaluate", str(session), "--truth", str(truth), "--json", str(tmp_path / "m.json")]) == 0
    measures = json.loads((tmp_path / "m.json").read_text())
    poses = measures["alignment"]
    assert poses["cameras"] == len(candidates(Session.open(session).frames)) > 20
    # A pixel is 0.17 degrees wide here, and a feature is found to a fifth of one.
    assert poses["rotation_median_deg"] < 0.3
    assert poses["centre_median_share"] < 0.01
    # Pictures that are not fitted. A pixel all along the outline is 4 % of the mask here, and a shoulder that
    # most frames cut off is as much again.
    assert measures["captured"]["psnr_db"] > 23
    assert measures["mask"]["iou"] > 0.9


def test_what_was_found_is_there_to_look_at_and_to_take_away(session):
    opened = Session.open(session)
    reports = StageCache(opened).reports()
    assert set(reports) == {"poses", "cloud", "masks", "scale"}
    cameras = opened.load_scene_cameras()
    assert sorted(cameras) == [record.index for record in candidates(opened.frames)]
    assert all(opened.load_mask(record) is not None for record in opened.frames if record.index in cameras)
    report = (session / "portraits" / "solve" / "report.html").read_text()
    assert "Found in the frames" in report
    assert "What was taken for the subject" in report


def test_a_second_fit_does_nothing_again(session):
    portrait = session / "portraits" / "solve" / "portrait.safetensors"
    stages = session / "scene" / "stages.json"
    before = portrait.stat().st_mtime_ns, stages.stat().st_mtime_ns
    assert main(["fit", str(session), "--device", "cpu"]) == 0
    assert (portrait.stat().st_mtime_ns, stages.stat().st_mtime_ns) == before


def test_the_metre_is_right_to_what_is_said_of_it(session, truth):
    scale = StageCache(Session.open(session)).reports()["scale"]
    cameras = Session.open(session).load_scene_cameras()
    true = json.loads((truth / "cameras.json").read_text())["frames"]
    centres = {
        frame["index"]: -np.array(frame["R"]).T @ np.array(frame["t"])
        for frame in true
        if frame["index"] in cameras
    }
    common = sorted(centres)
    found = np.linalg.norm(cameras[common[0]].centre_world - cameras[common[-1]].centre_world)
    real = np.linalg.norm(centres[common[0]] - centres[common[-1]])
    assert abs(found / real - 1.0) < 3.0 * scale["sigma_relative"]
