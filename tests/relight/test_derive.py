"""What is found for a session that lacks it, what is kept of it, and what is left when something fails."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import relight.derive as derive
from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.images import write_png
from capture.ply import PointCloud, read_ply, write_ply
from capture.session import Session
from relight.derive import derive_scene
from relight.errors import GeometryError
from relight.geometry_plan import FEWEST_POSES, GeometryConfig
from relight.masks import MaskConfig
from relight.plan import Action
from relight.planning import make_plan
from relight.scale import Scale
from relight.stage_cache import StageCache
from relight.stages import Stages

SIZE, COUNT = 24, 12
K = np.array([[30.0, 0, 12], [0, 30.0, 12], [0, 0, 1]])
STAGES = ("poses", "cloud", "masks", "scale")


def camera(index):
    cam_from_world = np.eye(4)
    cam_from_world[:3, 3] = [0.01 * index, 0.0, 0.55]
    return Camera(f"{index:06d}", SIZE, SIZE, K, cam_from_world)


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "images"}, width=SIZE, height=SIZE) as made:
        for index in range(COUNT):
            file = made.write_frame(index, np.full((SIZE, SIZE, 3), 100 + index, np.uint8))
            made.append_frame(FrameRecord(index=index, file=file, width=SIZE, height=SIZE, flash=index % 2))
    return made


class Finders:
    """Stand-ins for the stages, which give a plausible result and remember that they were asked."""

    def __init__(self):
        self.asked = []
        self.failing = None
        self.metric = False

    def _ask(self, stage):
        self.asked.append(stage)
        if self.failing == stage:
            raise GeometryError(f"no {stage}")

    def poses(self, session, records, config, progress):
        self._ask("poses")
        return SimpleNamespace(
            cameras={record.index: camera(record.index) for record in records[:-1]},
            points_world=np.ones((5, 3)),
            colors=None,
            metric=self.metric,
            scale_source="a board",
            report={"registered": len(records) - 1},
            warnings=("one frame has no pose",),
        )

    def cloud(self, session, cameras, points, config, device, progress):
        self._ask("cloud")
        assert len(points) == 5
        cloud = np.random.default_rng(0).normal(0, 0.05, (40, 3)).astype(np.float32)
        normals = np.tile(np.float32([0, 0, -1]), (40, 1))
        return SimpleNamespace(points=cloud, normals_world=normals, report={}, warnings=())

    def masks(self, session, cameras, points, normals, folder, config, progress):
        self._ask("masks")
        for index in cameras:
            write_png(folder / f"{index:06d}.png", np.full((SIZE, SIZE), 255, np.uint8))
        return SimpleNamespace(keep=np.arange(len(points)) < 30, report={}, warnings=())

    def scale(self, session, cameras, progress):
        self._ask("scale")
        return Scale(1.1, 0.05, "head", "a typical head")


@pytest.fixture
def finders(monkeypatch):
    stand_ins = Finders()
    monkeypatch.setattr(derive, "find_poses", stand_ins.poses)
    monkeypatch.setattr(derive, "dense_cloud", stand_ins.cloud)
    monkeypatch.setattr(derive, "find_masks", stand_ins.masks)
    monkeypatch.setattr(derive, "complete_with_masks", lambda session, cameras, cloud: cloud)
    monkeypatch.setattr(derive, "_scale_of", stand_ins.scale)
    return stand_ins


def run(session, config=None):
    config = config or GeometryConfig()
    session = Session.open(session.path)
    plan = make_plan(session, geometry=config)
    plan.check()
    derive_scene(session, plan, config, torch.device("cpu"), Stages())
    return make_plan(session, geometry=config).after(plan)


def test_everything_is_found_in_order_and_saved(session, finders):
    plan = run(session)
    assert finders.asked == list(STAGES)
    assert [plan.decision(stage).action for stage in STAGES] == [Action.RUN] * 4
    cameras = session.load_scene_cameras()
    assert sorted(cameras) == list(range(COUNT - 1))
    # All lengths are in the unit that the last stage found: 1.1 times what the poses had.
    assert cameras[0].centre_world[2] == pytest.approx(-0.55 * 1.1)
    np.testing.assert_allclose(read_ply(session.sparse_path).points, 1.1)
    assert len(read_ply(session.dense_path).points) == 40
    assert len(read_ply(session.points_path).points) == 30
    assert session.load_mask(session.frames[0]) is not None
    assert StageCache(session).reports()["poses"]["registered"] == COUNT - 1


def test_a_second_run_finds_nothing_anew(session, finders):
    run(session)
    finders.asked.clear()
    plan = run(session)
    assert finders.asked == []
    assert [plan.decision(stage).action for stage in STAGES] == [Action.KEPT] * 4


def test_a_frame_without_a_pose_is_left_out_of_the_fit(session, finders):
    plan = run(session)
    assert plan.left_out[COUNT - 1] == "no_pose"


def test_another_setting_of_a_stage_runs_it_and_those_after_it(session, finders):
    run(session)
    finders.asked.clear()
    run(session, GeometryConfig(masks=MaskConfig(rounds=1)))
    assert finders.asked == ["masks", "scale"]


def test_a_metric_reconstruction_keeps_its_unit(session, finders):
    finders.metric = True
    plan = run(session)
    assert finders.asked == ["poses", "cloud", "masks"]
    assert plan.decision("scale").action is Action.RUN
    assert session.load_scene_cameras()[0].centre_world[2] == pytest.approx(-0.55)
    assert make_plan(session).decision("scale").action is Action.KEPT


def test_what_was_found_before_a_failure_is_kept(session, finders):
    finders.failing = "masks"
    with pytest.raises(GeometryError, match="no masks"):
        run(session)
    assert not session.masks_dir.exists()
    finders.failing = None
    finders.asked.clear()
    run(session)
    assert finders.asked == ["masks", "scale"]


def test_given_poses_and_cloud_are_never_touched(session, finders):
    session.save_scene_cameras({record.index: camera(record.index) for record in session.frames})
    points = np.random.default_rng(1).normal(0, 0.05, (50, 3))
    write_ply(session.points_path, PointCloud(points))
    plan = run(session)
    assert finders.asked == []
    assert plan.decision("poses").action is plan.decision("cloud").action is Action.GIVEN
    assert plan.decision("masks").action is Action.SKIP  # the cloud is a head alone
    np.testing.assert_array_equal(read_ply(session.points_path).points, points)


def test_a_given_cloud_with_the_room_in_it_is_masked_but_not_rewritten(session, finders):
    session.save_scene_cameras({record.index: camera(record.index) for record in session.frames})
    points = np.random.default_rng(1).normal(0, 0.8, (50, 3))
    normals = np.tile(np.float32([0, 0, -1]), (50, 1))
    write_ply(session.points_path, PointCloud(points, normals=normals))
    run(session)
    assert finders.asked == ["masks"]
    np.testing.assert_array_equal(read_ply(session.points_path).points, points)


def test_a_cloud_without_its_poses_is_refused(session):
    session.scene_dir.mkdir()
    write_ply(session.points_path, PointCloud(np.ones((50, 3))))
    plan = make_plan(session)
    assert plan.decision("cloud").action is Action.REFUSE


def test_too_few_frames_for_poses_are_refused(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "images"}, width=SIZE, height=SIZE) as session:
        for index in range(FEWEST_POSES - 1):
            file = session.write_frame(index, np.full((SIZE, SIZE, 3), 90, np.uint8))
            session.append_frame(
                FrameRecord(index=index, file=file, width=SIZE, height=SIZE, flash=index % 2)
            )
    decision = make_plan(session).decision("poses")
    assert decision.action is Action.REFUSE
    assert f"{FEWEST_POSES - 1} usable frames" in decision.reason
