import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.cameras import Camera
from capture.errors import CalibrationError, RelightError, SessionError, TransferError
from capture.images import write_png
from capture.session import FrameRecord, Session
from capture.transfer import to_linear


def picture(index=0, shape=(6, 8, 3), kind=np.uint8):
    return np.random.default_rng(index).integers(0, np.iinfo(kind).max, shape).astype(kind)


def append(session, index, **changes):
    file = session.write_frame(index, picture(index))
    record = FrameRecord(index=index, file=file, width=8, height=6, flash=index % 2, **changes)
    session.append_frame(record)
    return record


def create(path, **changes):
    return Session.create(path, **({"source": {"kind": "test"}, "width": 8, "height": 6} | changes))


@pytest.fixture
def made(tmp_path):
    """A complete session of three frames."""
    with create(tmp_path / "S") as session:
        for index in range(3):
            append(session, index)
    return tmp_path / "S"


def test_what_is_recorded_is_read(tmp_path):
    with create(
        tmp_path / "S", transfer="sRGB", rotation_deg=90, device={"name": "x"}, flash_schedule={"hz": 1}
    ) as session:
        records = [
            append(session, index, pts_s=index / 30, reasons=("dropped_before",)) for index in range(3)
        ]
        session.append_frame(FrameRecord(index=7, file=None, width=8, height=6, reasons=("not_selected",)))
        assert session.status == "recording"
    again = Session.open(tmp_path / "S")
    assert (again.status, again.repairs) == ("complete", [])
    assert again.frames[:3] == records
    assert again.frames[3].file is None
    assert again.info["image"] == {"width": 8, "height": 6, "transfer": "srgb", "rotation_deg": 90}
    assert (again.info["device"], again.info["flash_schedule"]) == ({"name": "x"}, {"hz": 1})
    assert np.array_equal(again.load_image(records[1]), picture(1))


def test_every_line_is_on_the_disk_when_append_returns(tmp_path):
    session = create(tmp_path / "S")
    for index in range(3):
        append(session, index)
        assert len((tmp_path / "S/frames.jsonl").read_bytes().splitlines()) == index + 1
    session.finish()


def test_a_process_that_is_killed_leaves_a_readable_session(tmp_path):
    program = (
        "import os, sys, numpy as np\n"
        "from pathlib import Path\n"
        "from capture.session import FrameRecord, Session\n"
        "s = Session.create(Path(sys.argv[1]), source={'kind': 'test'}, width=8, height=6)\n"
        "for i in range(5):\n"
        "    file = s.write_frame(i, np.zeros((6, 8, 3), np.uint8))\n"
        "    s.append_frame(FrameRecord(index=i, file=file, width=8, height=6, flash=0))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    path = tmp_path / "S"
    assert subprocess.run([sys.executable, "-c", program, str(path)], check=False).returncode == -9
    session = Session.open(path)
    assert (session.status, len(session.frames)) == ("interrupted", 5)
    assert any("never closed" in sentence for sentence in session.repairs)
    with session:
        append(session, 5)
    again = Session.open(path)
    assert (again.status, len(again.frames), again.repairs) == ("complete", 6, [])


def test_an_exception_leaves_an_interrupted_session(tmp_path):
    def record():
        with create(tmp_path / "S") as session:
            append(session, 0)
            raise RuntimeError("unplugged")

    with pytest.raises(RuntimeError, match="unplugged"):
        record()
    assert Session.open(tmp_path / "S").status == "interrupted"


def test_reading_changes_nothing_on_the_disk(made):
    (made / "frames.jsonl").write_bytes((made / "frames.jsonl").read_bytes()[:-9])
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    with Session.open(made) as session:
        assert len(session.repairs) == 1
        session.load_radiance(session.frames[0])
    assert before == {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}


def cut_log(made, cut):
    """Cuts the log; gives the number of whole lines (one may lack its newline) and what is torn."""
    content = (made / "frames.jsonl").read_bytes()
    (made / "frames.jsonl").write_bytes(content[:cut])
    ends = [0, *(at + 1 for at, byte in enumerate(content) if byte == 10)]
    whole = sum(end - 1 <= cut for end in ends[1:])
    return whole, content[ends[whole] : cut]


def test_a_log_cut_at_any_byte_loses_at_most_its_last_frame(made):
    content = (made / "frames.jsonl").read_bytes()
    for cut in range(len(content) + 1):
        (made / "frames.jsonl").write_bytes(content)
        whole, torn = cut_log(made, cut)
        session = Session.open(made)
        assert [record.index for record in session.frames] == list(range(whole))
        assert len(session.repairs) == bool(torn)


@pytest.mark.parametrize("back", [0, 1, 2, 40])
def test_a_torn_line_is_kept_aside_when_recording_goes_on(made, back):
    whole, torn = cut_log(made, (made / "frames.jsonl").stat().st_size - back)
    with Session.open(made) as session:
        append(session, 9)
    again = Session.open(made)
    assert [record.index for record in again.frames] == [*range(whole), 9]
    assert again.repairs == []
    assert (made / "frames.torn").exists() == bool(torn)
    assert not torn or (made / "frames.torn").read_bytes() == torn + b"\n"


def test_a_tail_of_zeros_as_file_systems_leave_it_is_a_torn_line(made):
    with (made / "frames.jsonl").open("ab") as log:
        log.write(b"\0" * 100)
    session = Session.open(made)
    assert len(session.frames) == 3
    assert "torn" in session.repairs[0]


def test_a_line_that_cannot_be_written_leaves_the_log_as_it_was(tmp_path, monkeypatch):
    session = create(tmp_path / "S")
    append(session, 0)
    file = session.write_frame(1, picture(1))
    with monkeypatch.context() as patch:

        def full(descriptor):
            raise OSError(errno.ENOSPC, "No space left on device")

        patch.setattr(os, "fsync", full)
        with pytest.raises(SessionError, match="No space left"):
            session.append_frame(FrameRecord(index=1, file=file, width=8, height=6))
    append(session, 2)
    session.finish()
    assert [record.index for record in Session.open(tmp_path / "S").frames] == [0, 2]


def test_only_one_writer_at_a_time(made):
    first, second = Session.open(made), Session.open(made)
    append(first, 3)
    assert Session.open(made).status == "recording"
    second.write_frame(4, picture(4))
    with pytest.raises(SessionError, match="another process"):
        second.append_frame(FrameRecord(index=4, file="frames/000004.png", width=8, height=6))
    first.finish()
    with pytest.raises(SessionError, match="open it again"):
        second.append_frame(FrameRecord(index=4, file="frames/000004.png", width=8, height=6))
    assert len(Session.open(made).frames) == 4


def test_tags_can_be_set_afterwards_in_one_step(made):
    session = Session.open(made)
    session.replace_frames(
        [replace(record, flash=None, reasons=("partial_flash",)) for record in session.frames]
    )
    again = Session.open(made)
    assert (again.status, [record.flash for record in again.frames]) == ("complete", [None] * 3)
    with pytest.raises(SessionError, match="same frames"):
        session.replace_frames(session.frames[:2])


def test_a_missing_picture_is_said_and_its_frame_not_used_until_it_is_back(made):
    shutil.move(made / "frames/000001.png", made / "aside.png")
    session = Session.open(made)
    assert "frames/000001.png" in session.repairs[0]
    assert [record.usable for record in session.frames] == [True, False, True]
    with pytest.raises(SessionError, match="Frame 1"):
        session.load_image(session.frames[1])
    session.replace_frames(session.frames)
    shutil.move(made / "aside.png", made / "frames/000001.png")
    again = Session.open(made)
    assert again.repairs == []
    assert all(record.usable for record in again.frames)


def test_a_picture_of_another_size_is_refused_with_both_sizes(made):
    write_png(made / "frames/000001.png", np.zeros((5, 8, 3), np.uint8))
    session = Session.open(made)
    with pytest.raises(SessionError, match=r"frame 1 .* is 8 x 5 pixels, its record says 8 x 6"):
        session.load_radiance(session.frames[1])


def test_frames_are_never_overwritten_or_repeated(made):
    session = Session.open(made)
    with pytest.raises(SessionError, match="never overwritten"):
        session.write_frame(1, picture(1))
    with pytest.raises(SessionError, match="is there already"):
        session.append_frame(session.frames[0])
    with pytest.raises(SessionError, match="belongs to another"):
        session.append_frame(replace(session.frames[0], index=5))
    with pytest.raises(SessionError, match="before its line"):
        session.append_frame(replace(session.frames[0], index=5, file="frames/000005.png"))


def test_a_folder_in_use_is_not_taken(made, tmp_path):
    with pytest.raises(SessionError, match="not empty"):
        create(made)
    (tmp_path / "file").write_text("x")
    with pytest.raises(SessionError, match="cannot be made"):
        create(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    create(tmp_path / "empty").finish()


def test_impossible_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="rotation_deg"):
        create(tmp_path / "S", rotation_deg=45)
    with pytest.raises(TransferError):
        create(tmp_path / "S", transfer="film")
    with create(tmp_path / "S") as session, pytest.raises(ValueError, match="status"):
        session.finish("done")


def test_info_can_be_added_and_is_kept(made):
    session = Session.open(made)
    session.update_info(tagging={"period_s": 1.0})
    assert Session.open(made).info["tagging"] == {"period_s": 1.0}
    with pytest.raises(ValueError, match="status"):
        session.update_info(status="complete")
    with pytest.raises(SessionError, match=r"session\.json"):
        session.update_info(bad=float("nan"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(version=2), "newer program"),
        (lambda m: m.update(version=0), "version"),
        (lambda m: m.update(schema="other"), "'other'"),
        (lambda m: m.pop("schema"), "schema"),
        (lambda m: m.update(status="done"), "'done'"),
        (lambda m: m.pop("source"), "source"),
        (lambda m: m["image"].update(width=-1), "width"),
        (lambda m: m["image"].update(transfer="film"), "film"),
        (lambda m: m["image"].update(rotation_deg=30), "rotation_deg"),
        (lambda m: m.update(image=[]), "image"),
    ],
)
def test_a_foreign_or_damaged_manifest_is_refused(made, change, words):
    manifest = json.loads((made / "session.json").read_text())
    change(manifest)
    (made / "session.json").write_text(json.dumps(manifest))
    with pytest.raises(SessionError, match=words):
        Session.open(made)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"index": 0, "file": null, "width": 8, "height": 6}', "line 4: the frame 0 is there already"),
        ('{"index": 9, "file": "frames/000000.png", "width": 8, "height": 6}', "line 4: the picture"),
        ('{"index": 9, "file": null, "width": 8, "height": NaN}', "line 4: NaN"),
        ('{"index": 9, "file": null, "width": 8}', "line 4: height is missing"),
        ("garbage", "line 4"),
        ("", "line 4"),
        ("x" * (1 << 20), "line 4"),
    ],
)
def test_a_damaged_whole_line_is_refused_with_its_number(made, line, words):
    with (made / "frames.jsonl").open("a") as log:
        log.write(line + "\n")
    with pytest.raises(SessionError, match=words):
        Session.open(made)


def test_a_folder_that_is_no_session_says_how_to_make_one(tmp_path, made):
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(SessionError, match="relight import"):
            Session.open(path)
    (made / "frames.jsonl").unlink()
    with pytest.raises(SessionError, match=r"frames\.jsonl cannot be read"):
        Session.open(made)


def test_a_session_without_frames_is_a_session(tmp_path):
    create(tmp_path / "S").finish()
    session = Session.open(tmp_path / "S")
    assert (session.frames, session.repairs) == ([], [])


def test_radiance_goes_by_the_transfer_then_by_the_calibrated_response(made):
    session = Session.open(made)
    radiance = session.load_radiance(session.frames[0])
    assert radiance.dtype == np.float32
    assert np.array_equal(radiance, to_linear(picture(0), "srgb"))
    header = {"schema": "relight-calibration", "version": 1}
    table = {"stored": [0, 1], "linear": [[0, 0, 0], [1, 0.5, 0.25]]}
    (made / "calibration.json").write_text(json.dumps(header | {"response": {"table": table}}))
    session = Session.open(made)
    expected = picture(0) / 255 * [1, 0.5, 0.25]
    assert session.load_radiance(session.frames[0]) == pytest.approx(expected, abs=1e-7)  # float32
    (made / "calibration.json").write_text(json.dumps(header | {"response": {"transfer": "gamma:2"}}))
    session = Session.open(made)
    assert session.load_radiance(session.frames[0]) == pytest.approx((picture(0) / 255) ** 2, abs=1e-7)
    (made / "calibration.json").write_text("{}")
    session = Session.open(made)
    with pytest.raises(CalibrationError, match="schema"):
        session.load_radiance(session.frames[0])


def test_grey_frames_have_three_equal_channels_and_floats_are_radiance(tmp_path):
    with create(tmp_path / "S") as session:
        grey = picture(0, (6, 8), np.uint16)
        session.append_frame(FrameRecord(index=0, file=session.write_frame(0, grey), width=8, height=6))
        file = session.write_frame(1, np.full((6, 8, 3), 1.5), ".exr")
        session.append_frame(FrameRecord(index=1, file=file, width=8, height=6))
    radiance = session.load_radiance(session.frames[0])
    assert np.array_equal(radiance, np.repeat(to_linear(grey, "srgb")[..., None], 3, axis=2))
    assert (session.load_radiance(session.frames[1]) == 1.5).all()


def test_masks_are_read_by_frame(made):
    session = Session.open(made)
    assert session.load_mask(session.frames[0]) is None
    session.masks_dir.mkdir(parents=True)
    write_png(session.mask_path(0), np.full((6, 8), 9, np.uint8))
    assert (session.load_mask(session.frames[0]) == 9).all()
    write_png(session.mask_path(1), np.zeros((5, 8), np.uint8))
    with pytest.raises(SessionError, match=r"000001\.png"):
        session.load_mask(session.frames[1])


def camera(width=8):
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.2, 0.7]
    return Camera("x", width, 6, np.array([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]), pose)


def test_scene_cameras_belong_to_frames(made):
    session = Session.open(made)
    session.save_scene_cameras({0: camera(), 1: camera()})
    found = Session.open(made).load_scene_cameras()
    assert list(found) == [0, 1]
    assert (found[1].name, found[1].flash, found[0].flash) == ("000001", 1, 0)
    assert np.array_equal(found[1].cam_from_world, camera().cam_from_world)
    with pytest.raises(SessionError, match="no kept frame 8"):
        session.save_scene_cameras({8: camera()})
    session.save_scene_cameras({0: camera(width=9)})
    with pytest.raises(SessionError, match="fits no frame"):
        session.load_scene_cameras()


@settings(max_examples=150)
@given(data=st.data())
def test_damage_to_log_and_manifest_is_repaired_or_refused(damage, scratch, data):
    path = scratch / "S"
    if not path.is_dir():
        with create(path) as session:
            for index in range(2):
                append(session, index, pts_s=0.1)
        shutil.copytree(path, scratch / "original")
    name = data.draw(st.sampled_from(["frames.jsonl", "session.json"]))
    for other in ("frames.jsonl", "session.json"):
        shutil.copy(scratch / "original" / other, path / other)
    (path / name).write_bytes(data.draw(damage((path / name).read_bytes())))
    with contextlib.suppress(SessionError):
        session = Session.open(path)
        for record in session.frames:
            with contextlib.suppress(RelightError):
                session.load_radiance(record)
