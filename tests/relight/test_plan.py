"""What the plan decides for sessions that lack, bring or do not need something."""

import json
from dataclasses import replace

import numpy as np
import pytest

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.images import write_png
from capture.ply import PointCloud, write_ply
from capture.session import Session
from relight.errors import PlanError
from relight.plan import Action, parse_forced
from relight.planning import FEWEST_UNLIT, make_plan
from relight.view_redundancy import ENOUGH_REPEATS

WIDTH, HEIGHT = 64, 48
K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])


def camera_at(azimuth_deg, flash, distortion=()):
    """Half a metre from the origin, looking at it."""
    angle = np.deg2rad(azimuth_deg)
    centre = 0.5 * np.array([np.sin(angle), 0, np.cos(angle)])
    forward = -centre / 0.5
    right = np.cross([0, -1, 0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return Camera("", WIDTH, HEIGHT, K, pose, np.array(distortion), flash)


def make_session(
    path,
    flags=(1, 0, 0, 0) * 4,
    *,
    azimuths=None,
    room=0.2,
    normals=False,
    poses=True,
    cloud=True,
    distortion=(),
    reasons=None,
    masks=False,
):
    """A session of flat grey frames: what a plan looks at is there, what only a solve looks at is not."""
    reasons = reasons or {}
    azimuths = np.linspace(-60, 60, len(flags)) if azimuths is None else azimuths
    with Session.create(
        path, source={"kind": "test"}, width=WIDTH, height=HEIGHT, transfer="linear"
    ) as session:
        cameras = {}
        for index, flash in enumerate(flags):
            radiance = room + (0.5 if flash == 1 else 0.0)
            image = np.full((HEIGHT, WIDTH, 3), round(255 * radiance), np.uint8)
            file = session.write_frame(index, image)
            session.append_frame(
                FrameRecord(
                    index=index,
                    file=file,
                    width=WIDTH,
                    height=HEIGHT,
                    flash=flash,
                    reasons=reasons.get(index, ()),
                )
            )
            cameras[index] = camera_at(azimuths[index], flash, distortion)
        if poses:
            session.save_scene_cameras(cameras)
        if cloud:
            points = np.random.default_rng(0).normal(0, 0.05, (500, 3))
            unit = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
            session.scene_dir.mkdir(exist_ok=True)
            write_ply(session.points_path, PointCloud(points, unit if normals else None))
        if masks:
            session.masks_dir.mkdir(parents=True)
            for index in range(len(flags)):
                write_png(session.mask_path(index), np.full((HEIGHT, WIDTH), 255, np.uint8))
    return Session.open(path)


def actions(plan):
    return {decision.name: decision.action for decision in plan.decisions}


def test_a_session_with_poses_and_a_cloud_can_be_fitted(tmp_path):
    plan = make_plan(make_session(tmp_path / "s"))
    plan.check()
    assert actions(plan) == {
        "frames": Action.RUN,
        "flash": Action.GIVEN,
        "poses": Action.GIVEN,
        "redundant_views": Action.RUN,
        "undistortion": Action.SKIP,
        "cloud": Action.GIVEN,
        "normals": Action.RUN,
        "masks": Action.SKIP,
        "calibration": Action.SKIP,
        "scale": Action.GIVEN,
        "face_prior": Action.RUN,
        "room_shading": Action.RUN,
        "time": Action.RUN,
    }
    assert plan.frames == tuple(range(16))
    assert plan.left_out == {}
    assert plan.estimated_s > 0


def test_what_the_scene_brings_is_taken(tmp_path):
    plan = make_plan(make_session(tmp_path / "s", normals=True, masks=True))
    assert "which side is out" in plan.decision("normals").reason
    assert plan.decision("masks").action is Action.GIVEN
    assert "16 of 16" in plan.decision("masks").reason


def test_what_is_not_given_is_found(tmp_path):
    plan = make_plan(make_session(tmp_path / "s", poses=False, cloud=False))
    plan.check()
    steps = actions(plan)
    assert [steps[name] for name in ("poses", "cloud", "masks", "scale")] == [Action.RUN] * 4
    given = make_plan(make_session(tmp_path / "given"))
    assert plan.estimated_s > given.estimated_s
    with_poses = make_plan(make_session(tmp_path / "posed", cloud=False))
    assert actions(with_poses)["cloud"] is Action.RUN


@pytest.mark.parametrize(
    ("options", "name", "word"),
    [
        ({"poses": False}, "cloud", "without the poses"),
        ({"poses": False, "cloud": False, "flags": (1, 0, 0)}, "poses", "3 usable frames are too few"),
        ({"flags": (0,) * 8}, "flash", "no frame is fully lit"),
        ({"flags": (1,) * 8}, "flash", "all 8 frames are lit"),
    ],
)
def test_a_session_that_cannot_be_fitted_is_refused_with_what_to_add(tmp_path, options, name, word):
    plan = make_plan(make_session(tmp_path / "s", **options))
    assert plan.decision(name).action is Action.REFUSE
    with pytest.raises(PlanError, match=word):
        plan.check()


def test_few_flash_frames_are_said_to_leave_the_normals(tmp_path):
    assert "normals" in make_plan(make_session(tmp_path / "two", (1, 0, 0, 1))).decision("flash").reason
    assert "normals" not in make_plan(make_session(tmp_path / "three", (1, 0, 1, 1))).decision("flash").reason


def test_frames_that_cannot_be_used_are_left_out_and_say_why(tmp_path):
    session = make_session(tmp_path / "s", reasons={2: ("blurred",), 3: ("dropped_before",)})
    records = list(session.frames)
    records[5] = replace(records[5], flash=None, reasons=("partial_flash",))
    records[6] = replace(records[6], split="val")
    session.replace_frames(records)
    plan = make_plan(session)
    assert plan.left_out == {2: "blurred", 5: "partial_flash", 6: "kept_for_validation"}
    assert 3 in plan.frames  # a remark excludes nothing
    assert "1 kept for validation" in plan.decision("frames").reason


def test_a_frame_without_a_pose_is_left_out(tmp_path):
    session = make_session(tmp_path / "s")
    session.save_scene_cameras({index: camera_at(5 * index, 0) for index in range(12)})
    plan = make_plan(session)
    assert plan.frames == tuple(range(12))
    assert set(plan.left_out.values()) == {"no_pose"}


def test_a_dark_room_needs_no_shading_and_a_lit_one_does(tmp_path):
    flags = (1, 0, 0, 0) * 5
    dark = make_plan(make_session(tmp_path / "dark", flags, room=0.0))
    assert dark.decision("room_shading").action is Action.SKIP
    # 15 unlit frames, of which as many stay as a dark room needs.
    assert list(dark.left_out.values()) == ["dark"] * (15 - FEWEST_UNLIT)
    # 3 levels of 255 in a lit frame of 0.5: 2.3 %, above the 1 % of DARK_ROOM.
    dim = make_plan(make_session(tmp_path / "dim", room=3 / 255))
    assert dim.decision("room_shading").action is Action.RUN


def test_a_lens_that_bends_is_undistorted_and_one_that_does_not_is_left(tmp_path):
    # At the corner r is 40 / 60 of the focal length: k1 r^3 f is 0.9 px for k1 = 0.05, 0.02 px for 0.001.
    bent = make_plan(make_session(tmp_path / "bent", distortion=(0.05, 0, 0, 0)))
    straight = make_plan(make_session(tmp_path / "straight", distortion=(0.001, 0, 0, 0)))
    assert bent.decision("undistortion").action is Action.RUN
    assert "0.89 px" in bent.decision("undistortion").reason
    assert straight.decision("undistortion").action is Action.SKIP


def test_a_hand_that_stands_still_repeats_views_and_lit_ones_are_kept(tmp_path):
    flags = (1, 0, 0, 0) * 10
    azimuths = np.concatenate([np.linspace(-60, 60, 20), np.full(20, 60.0)])
    plan = make_plan(make_session(tmp_path / "s", flags, azimuths=azimuths))
    assert plan.decision("redundant_views").action is Action.SKIP
    still_lit = [index for index in range(20, 40) if flags[index] == 1]
    still_unlit = [index for index in range(19, 40) if flags[index] == 0]
    assert set(still_lit) <= set(plan.frames)
    assert sorted(plan.left_out) == still_unlit[ENOUGH_REPEATS:]
    assert plan.left_out[39] == "same view as frame 19"


def test_a_short_time_leaves_out_unlit_frames_evenly_and_never_too_many(tmp_path):
    session = make_session(tmp_path / "s", (1, 0, 0, 0) * 10)
    whole = make_plan(session)
    # The time goes with the frames: between all 40 and none, that of 30.
    fewest = make_plan(session, max_seconds=1e-9)
    per_frame_s = (whole.estimated_s - fewest.estimated_s) / (len(whole.frames) - len(fewest.frames))
    allowed_s = whole.estimated_s - 9.5 * per_frame_s
    shorter = make_plan(session, max_seconds=allowed_s)
    assert len(shorter.frames) == 30
    assert shorter.estimated_s <= allowed_s
    assert set(shorter.left_out.values()) == {"no_time"}
    assert all(index in shorter.frames for index in range(0, 40, 4))  # the lit ones
    # 20 of the 30 unlit frames: none is missing beside a missing one, and a lit one may lie between.
    assert np.diff([index for index in shorter.frames if index % 4]).max() <= 3
    assert len(fewest.frames) == 10 + FEWEST_UNLIT
    assert "allowed" in fewest.decision("time").reason


def test_decisions_can_be_turned_round_and_say_so(tmp_path):
    session = make_session(tmp_path / "s", azimuths=np.full(16, 10.0), distortion=(0.05, 0, 0, 0), room=0.0)
    forced = parse_forced(["undistortion=skip", "redundant_views=run", "room_shading=run"])
    plan = make_plan(session, forced)
    for name, action in forced.items():
        assert plan.decision(name).action is action
        assert plan.decision(name).forced
    assert len(plan.frames) == 16


def test_forcing_what_is_already_decided_is_not_called_forced(tmp_path):
    plan = make_plan(make_session(tmp_path / "s"), parse_forced(["room_shading=run"]))
    assert not plan.decision("room_shading").forced


@pytest.mark.parametrize("text", ["poses=run", "room_shading", "room_shading=maybe", "", "=run"])
def test_forcing_anything_else_names_what_can_be_forced(text):
    with pytest.raises(PlanError, match="undistortion, redundant_views, room_shading"):
        parse_forced([text])


def test_the_plan_survives_json(tmp_path):
    plan = make_plan(make_session(tmp_path / "s", reasons={2: ("blurred",)}))
    said = json.loads(json.dumps(plan.as_json()))
    assert said["left_out"] == {"2": "blurred"}
    assert said["decisions"][0]["action"] == "run"
    assert len(said["frames"]) == 15


def test_an_empty_session_is_refused(tmp_path):
    plan = make_plan(make_session(tmp_path / "s", flags=(), azimuths=(), poses=False))
    with pytest.raises(PlanError):
        plan.check()


def test_a_capture_that_was_killed_is_to_be_gone_on_with(tmp_path):
    session = make_session(tmp_path / "s", flags=(None,) * 4, poses=False)
    session.info["source"], session.status = {"kind": "capture"}, "interrupted"
    with pytest.raises(PlanError, match="relight-capture --resume"):
        make_plan(session).check()
    session.status = "complete"
    with pytest.raises(PlanError) as refusal:
        make_plan(session).check()
    assert "--resume" not in str(refusal.value)
