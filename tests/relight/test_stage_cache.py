"""What is done again, and what is not."""

import json
from dataclasses import replace

import numpy as np
import pytest

from capture.cameras import Camera
from capture.frame_record import FrameRecord
from capture.ply import PointCloud, write_ply
from capture.session import Session
from relight.stage_cache import StageCache

K = np.array([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]])


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "images"}, width=16, height=16) as made:
        for index in range(3):
            file = made.write_frame(index, np.full((16, 16, 3), 10 * index, np.uint8))
            made.append_frame(FrameRecord(index=index, file=file, width=16, height=16, flash=index % 2))
    return made


def save_poses(session, shift=0.0):
    cam_from_world = np.eye(4)
    cam_from_world[0, 3] = shift
    session.save_scene_cameras({k: Camera(str(k), 16, 16, K, cam_from_world) for k in range(3)})
    write_ply(session.sparse_path, PointCloud(np.ones((2, 3))))


def key(cache, session, settings=None):
    return cache.key("poses", settings or {"a": 1}, session.frames)


def test_what_the_user_brings_is_given(session):
    save_poses(session)
    cache = StageCache(session)
    assert cache.is_given("poses")
    assert cache.record("poses") is None
    assert cache.identity("poses").startswith("given ")
    assert not cache.is_given("cloud")
    assert cache.identity("cloud") == ""


def test_what_was_computed_is_remembered_by_another_run(session):
    cache = StageCache(session)
    save_poses(session)
    cache.store("poses", key(cache, session), settings={"a": 1}, report={"registered": 3}, warnings=["mind"])
    again = StageCache(Session.open(session.path))
    record = again.record("poses")
    assert record.key == key(again, session)
    assert record.report == {"registered": 3}
    assert again.warnings() == ["mind"]
    assert not again.is_given("poses")


def test_another_setting_flag_or_picture_is_another_key(session):
    cache = StageCache(session)
    before = key(cache, session)
    assert key(cache, session, {"a": 2}) != before
    session.replace_frames([replace(record, flash=1) for record in session.frames])
    assert key(StageCache(session), session) != before


def test_a_picture_that_changed_is_another_key(session):
    before = key(StageCache(session), session)
    picture = session.path / session.frames[1].file
    picture.write_bytes(picture.read_bytes() + b" ")
    assert key(StageCache(session), session) != before


def test_files_that_the_user_put_over_ours_are_given(session):
    cache = StageCache(session)
    save_poses(session)
    cache.store("poses", "k", settings={}, report={})
    save_poses(session, shift=0.5)
    assert StageCache(session).is_given("poses")


def test_what_an_interruption_tore_is_neither_given_nor_done(session):
    cache = StageCache(session)
    cache.begin("poses")
    save_poses(session)  # and no store: the power went
    torn = StageCache(session)
    assert not torn.is_given("poses")
    assert torn.record("poses") is None
    assert not torn.is_whole("poses")


def test_a_rescaled_result_is_the_same_result(session):
    cache = StageCache(session)
    save_poses(session)
    cache.store("poses", "k", settings={}, report={})
    cache.begin("poses")
    save_poses(session, shift=2.0)
    cache.moved("poses")
    assert StageCache(session).record("poses").key == "k"


def test_forgetting_has_all_done_again_but_what_is_given(session):
    cache = StageCache(session)
    save_poses(session)
    cache.store("poses", "k", settings={}, report={})
    cache.forget_all()
    assert StageCache(session).record("poses").key == ""
    assert not StageCache(session).is_given("poses")


@pytest.mark.parametrize("text", ["", "{", '{"schema": 99}', '{"schema": 1, "stages": {"poses": 3}}'])
def test_an_unreadable_file_counts_as_none(session, text):
    session.scene_dir.mkdir()
    (session.scene_dir / "stages.json").write_text(text)
    assert StageCache(session).record("poses") is None


def test_the_file_can_be_read_by_a_person(session):
    cache = StageCache(session)
    save_poses(session)
    cache.store("poses", "k", settings={"a": 1}, report={"registered": 3}, seconds=1.23456)
    content = json.loads((session.scene_dir / "stages.json").read_text())
    assert content["stages"]["poses"]["report"] == {"registered": 3}
    assert content["stages"]["poses"]["seconds"] == 1.235
