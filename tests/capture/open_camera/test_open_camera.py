"""Import of Open Camera videos: every frame is accounted for, lit ones are kept, pictures are right."""

import json
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import av
import numpy as np
import pytest

from capture.errors import SessionError, SourceError, TaggingError
from capture.importers import import_source
from capture.importers.open_camera import import_videos
from capture.importers.options import ImportOptions
from capture.session import FrameRecord, Session
from capture.video import decode_video, probe_video
from capture.video.colour import rgb_from_frame

SUBTITLES = """1
00:00:00,000 --> 00:00:00,999
02.11.2026 10:15:30
52.5200, 13.4050, 34.5m
"""


def flags(session: Session) -> list[int | None]:
    return [record.flash for record in session.frames]


def kept(session: Session) -> list[FrameRecord]:
    return [record for record in session.frames if record.file is not None]


def session_text(session: Session) -> str:
    """All that the session says in text."""
    files = [path for path in session.path.rglob("*") if path.suffix in (".json", ".jsonl", ".txt")]
    return "".join(path.read_text() for path in files)


@pytest.fixture(scope="module")
def session(video: Path, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The film, imported without any option."""
    return import_videos([video], tmp_path_factory.mktemp("session") / "S", ImportOptions())


# ---------------------------------------------------------------- frames


def test_every_frame_has_a_line_at_its_own_time(session: Session, film) -> None:
    assert [record.index for record in session.frames] == list(range(len(film.times_s())))
    times = [record.pts_s for record in session.frames]
    # Half a tick of the container's clock.
    np.testing.assert_allclose(times, film.times_s(), atol=0.51 / 90_000)
    assert session.status == "complete"
    assert Session.open(session.path).frames == session.frames


def test_no_frame_has_a_wrong_flag(session: Session, film) -> None:
    wrong = [
        (index, found, true)
        for index, (found, true) in enumerate(zip(flags(session), film.labels(), strict=True))
        if found is not None and found != true
    ]
    assert wrong == []


def test_all_pulses_are_found(session: Session, film) -> None:
    found = np.array([pulse["t_on_s"] for pulse in session.info["tagging"]["pulses"]])
    times = film.times_s()
    # A pulse that begins with the last frames may be too short to be one.
    true = [on_s for on_s in film.pulses_s() if times[0] < on_s < times[-1] - film.on_s]
    for on_s in true:
        # A frame interval: what no tagger may miss. How well edges are found is the tagger's own test.
        assert np.abs(found - on_s).min() < 1 / film.rate_hz
    assert session.info["tagging"]["period_s"] == pytest.approx(film.period_s, abs=0.01)


def test_all_lit_frames_are_kept_and_no_partial_one(session: Session) -> None:
    for record in session.frames:
        if record.flash == 1:
            assert record.file is not None
        if record.flash is None:
            assert record.file is None
            assert {"partial_flash", "flash_uncertain"} & set(record.reasons)
    assert sum(record.flash == 1 for record in session.frames) >= 6


def test_about_six_unlit_frames_a_second_are_kept_and_the_others_say_why(session: Session, film) -> None:
    unlit = [record for record in session.frames if record.flash == 0]
    chosen = [record for record in unlit if record.file is not None]
    # At most one in each sixth of a second; a pulse leaves an interval without an unlit frame now and then.
    assert 0.8 * 6 * film.seconds <= len(chosen) <= 6 * film.seconds + 1
    assert all("not_selected" in record.reasons for record in unlit if record.file is None)
    assert all(record.usable for record in chosen)


def test_the_rate_and_the_number_can_be_chosen(video: Path, tmp_path: Path) -> None:
    few = import_videos([video], tmp_path / "few", ImportOptions(kept_rate_hz=2.0))
    assert sum(record.flash == 0 for record in kept(few)) == pytest.approx(12, abs=1)
    limited = import_videos([video], tmp_path / "limited", ImportOptions(max_frames=10))
    assert len(kept(limited)) == 10
    assert {record.flash for record in kept(limited)} == {0, 1}


def test_pictures_are_the_frames_in_sensor_orientation(session: Session, video: Path) -> None:
    info = probe_video(video)
    assert session.info["image"]["rotation_deg"] == 90
    assert (session.info["image"]["width"], session.info["image"]["height"]) == (info.width, info.height)
    decoded = {frame.number: rgb_from_frame(frame.picture, info.colour) for frame in decode_video(info)}
    for record in kept(session)[:5]:
        np.testing.assert_array_equal(session.load_image(record), decoded[record.index])


def test_radiance_is_linear_in_the_light(session: Session, film) -> None:
    lit = next(record for record in kept(session) if record.flash == 1)
    unlit = [record for record in kept(session) if record.flash == 0]
    near = min(unlit, key=lambda record: abs((record.pts_s or 0) - (lit.pts_s or 0)))
    ratio = session.load_radiance(lit).mean() / session.load_radiance(near).mean()
    # The scene moves by a pixel between the two, and the encoder smooths noise.
    assert ratio == pytest.approx(1 + film.flash_gain, rel=0.03)


def test_ten_bit_hevc_is_kept_in_sixteen_bits(film, tmp_path: Path) -> None:
    video = replace(film, seconds=3.0).write(tmp_path / "a.mp4", codec="hevc", bits=10, color_range="full")
    session = import_videos([video], tmp_path / "S", ImportOptions())
    assert session.load_image(kept(session)[0]).dtype == np.uint16
    assert session.info["source"]["codec"] == "hevc"
    assert 1 in flags(session)


def test_a_late_start_is_kept(film, flash_list: Path, tmp_path: Path) -> None:
    late = replace(film, seconds=3.0, start_s=0.35)
    session = import_videos(
        [late.write(tmp_path / "a.mp4")], tmp_path / "S", ImportOptions(flash_list=flash_list)
    )
    assert session.frames[0].pts_s == pytest.approx(late.times_s()[0], abs=0.51 / 90_000)


def test_missing_frames_are_remarked(
    film, flash_list: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times, rows = film.times_s(), film.lit_rows()
    present = np.delete(np.arange(len(times)), [50, 51, 52])
    monkeypatch.setattr(type(film), "times_s", lambda self: times[present])
    monkeypatch.setattr(type(film), "lit_rows", lambda self: rows[present])
    session = import_videos(
        [film.write(tmp_path / "a.mp4")], tmp_path / "S", ImportOptions(flash_list=flash_list)
    )
    assert [record.index for record in session.frames if "dropped_before" in record.reasons] == [50]


# ---------------------------------------------------------------- colour


def test_untagged_video_warns_in_the_session(film, flash_list: Path, tmp_path: Path) -> None:
    untagged = {"color_range": None, "matrix": None, "transfer": None}
    video = replace(film, seconds=3.0).write(tmp_path / "a.mp4", **untagged)
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert any("no matrix tag" in warning for warning in session.info["warnings"])
    assert session.info["source"]["matrix"] == "bt601"


def test_the_users_transfer_beats_the_settings_and_these_the_tag(
    film, flash_list: Path, tmp_path: Path
) -> None:
    video = replace(film, seconds=3.0, transfer="log:100@64").write(tmp_path / "a.mp4")
    (tmp_path / "BACKUP_OC_1.xml").write_text(
        '<open_camera_prefs><string key="preference_video_log" value="medium"/></open_camera_prefs>'
    )
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert session.info["image"]["transfer"] == "log:100@64"
    assert session.info["source"]["transfer_tag"] == "rec709"
    asked = import_videos([video], tmp_path / "T", ImportOptions(flash_list=flash_list, transfer="gamma:2.2"))
    assert asked.info["image"]["transfer"] == "gamma:2.2"


# ---------------------------------------------------------------- several files


def test_parts_are_joined_on_one_time_axis(film, flash_list: Path, tmp_path: Path) -> None:
    first = replace(film, seconds=3.0)
    first.write(tmp_path / "VID_20261102_101530.mp4")
    second = replace(film, seconds=2.0, first_flash_s=film.first_flash_s + 3 * film.period_s - 3.0)
    second.write(tmp_path / "VID_20261102_101533.mp4")
    session = import_source(
        [tmp_path / "VID_20261102_101530.mp4"], tmp_path / "S", ImportOptions(flash_list=flash_list)
    )
    assert len(session.frames) == 150
    assert [entry["name"][-10:] for entry in session.info["source"]["files"]] == ["101530.mp4", "101533.mp4"]
    times = np.array([record.pts_s for record in session.frames])
    assert np.all(np.diff(times) > 0)
    # The first frame of the second part comes one frame interval, give or take the wander of 4 ms, after the
    # last.
    assert times[90] - times[89] == pytest.approx(1 / film.rate_hz, abs=0.0045)
    assert session.frames[90].source == "VID_20261102_101533.mp4"
    assert any("was joined to it" in warning for warning in session.info["warnings"])


# ---------------------------------------------------------------- sidecars


def test_where_it_was_filmed_is_left_out_unless_asked_for(film, flash_list: Path, tmp_path: Path) -> None:
    ended = datetime(2026, 11, 2, 9, 15, 33, tzinfo=UTC)
    video = replace(film, seconds=3.0).write(
        tmp_path / "VID_20261102_101530.mp4", location="+48.1371+011.5754/", creation_time=ended
    )
    video.with_suffix(".srt").write_text(SUBTITLES)
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    text = session_text(session)
    assert not any(number in text for number in ("48.13", "11.57", "52.52", "13.40", "34.5"))
    assert session.info["source"]["started"] == "2026-11-02T10:15:30"
    assert session.info["source"]["started_text"] == "02.11.2026 10:15:30"
    assert session.info["source"]["ended_utc"] == "2026-11-02T09:15:33+00:00"
    asked = import_videos([video], tmp_path / "T", ImportOptions(flash_list=flash_list, keep_location=True))
    assert asked.info["source"]["location"] == ["+48.1371+011.5754/", "52.5200, 13.4050, 34.5m"]


def write_logs(video: Path, frame_times: np.ndarray, flash_times: np.ndarray, origin_ns: int) -> None:
    folder = video.parent / "20261102_101530"
    folder.mkdir()
    for ending, times in (("_imu_timestamps.csv", frame_times), ("_flash.csv", flash_times)):
        lines = "".join(f"{origin_ns + round(time * 1e9)}\n" for time in times)
        (folder / (video.stem + ending)).write_text(lines)


def test_clock_logs_give_frames_their_clock_and_the_tagger_a_prior(film, tmp_path: Path) -> None:
    video = film.write(tmp_path / "VID_20261102_101530.mp4")
    # The torch needs 20 ms from the command to the light.
    flash_times = film.pulses_s()[film.pulses_s() < film.times_s()[-1]] - 0.020
    write_logs(video, film.times_s(), flash_times, 81_234_567_890_123)
    session = import_videos([video], tmp_path / "S", ImportOptions())
    clock = np.array([record.device_timestamp_ns for record in session.frames], float)
    np.testing.assert_allclose(clock, 81_234_567_890_123 + film.times_s() * 1e9, atol=1e3)
    prior = session.info["tagging"]["prior"]
    assert prior["source"] == "flash log"
    # What the log and the pictures differ by is the torch's latency; its pulses are matched one by one.
    assert prior["offset_s"] == pytest.approx(0.020, abs=0.003)
    assert prior["matched"] == len(flash_times)
    assert session.info["flash_schedule"]["on_s"] == 0.1
    assert all(found in (None, true) for found, true in zip(flags(session), film.labels(), strict=True))


def test_a_flash_log_that_contradicts_the_pictures_is_left_out_and_named(film, tmp_path: Path) -> None:
    video = film.write(tmp_path / "VID_20261102_101530.mp4")
    write_logs(video, film.times_s(), np.arange(0.1, 5.5, 0.37), 10**12)
    session = import_videos([video], tmp_path / "S", ImportOptions())
    assert session.info["tagging"]["prior"] is None
    assert any("belongs to another recording" in warning for warning in session.info["warnings"])
    assert all(found in (None, true) for found, true in zip(flags(session), film.labels(), strict=True))


def test_logs_of_another_video_are_left_out_and_named(film, flash_list: Path, tmp_path: Path) -> None:
    video = film.write(tmp_path / "VID_20261102_101530.mp4")
    write_logs(video, np.arange(180) / 24.0, np.array([0.1]), 10**12)
    (tmp_path / "20261102_101530" / (video.stem + "_flash.csv")).unlink()
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert session.frames[0].device_timestamp_ns is None
    assert any("contradict its own" in warning for warning in session.info["warnings"])


def test_damaged_sidecars_do_not_stop_an_import(film, flash_list: Path, tmp_path: Path) -> None:
    video = replace(film, seconds=3.0).write(tmp_path / "VID_20261102_101530.mp4")
    for name in (
        f"{video.stem}.srt",
        f"{video.stem}_flash.csv",
        f"{video.stem}_timestamps.csv",
        "BACKUP_OC_1.xml",
    ):
        (tmp_path / name).write_bytes(b"\xff\x00<garbage>")
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    left_out = [warning for warning in session.info["warnings"] if "sidecar was left out" in warning]
    assert len(left_out) == 4
    assert session.info["source"]["sidecars"] == []


def test_settings_that_harm_are_warned_of_and_the_exposure_is_recorded(
    film, flash_list: Path, tmp_path: Path
) -> None:
    video = replace(film, seconds=3.0).write(tmp_path / "a.mp4")
    (tmp_path / "BACKUP_OC_1.xml").write_text(
        "<open_camera_prefs>"
        '<string key="preference_iso" value="400"/><long key="preference_exposure_time" value="5000000"/>'
        '<boolean key="preference_video_stabilization" value="true"/>'
        "</open_camera_prefs>"
    )
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert any("stabilisation is on" in warning for warning in session.info["warnings"])
    assert {record.exposure_s for record in session.frames} == {0.005}
    assert session.info["device"]["iso"] == 400


def test_subtitles_longer_than_the_video_are_warned_of(film, flash_list: Path, tmp_path: Path) -> None:
    video = replace(film, seconds=3.0).write(tmp_path / "a.mp4")
    cue = "1\n00:00:{:02d},000 --> 00:00:{:02d},999\n10:15:30\n\n"
    video.with_suffix(".srt").write_text("".join(cue.format(k, k) for k in range(20)))
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert any("do not belong together" in warning for warning in session.info["warnings"])


# ---------------------------------------------------------------- flash list


def test_a_flash_list_takes_the_place_of_tagging(film, video: Path, tmp_path: Path) -> None:
    lines = [f"{index:06d}, {label}" for index, label in enumerate(film.labels()) if label is not None]
    (tmp_path / "flash.csv").write_text("\n".join(lines))
    session = import_videos([video], tmp_path / "S", ImportOptions(flash_list=tmp_path / "flash.csv"))
    assert flags(session) == film.labels()
    assert session.info["tagging"] is None


# ---------------------------------------------------------------- where it is put


def test_a_folder_that_is_in_use_is_refused_before_any_work(
    video: Path, tmp_path: Path, session: Session
) -> None:
    with pytest.raises(SessionError, match="holds a session already"):
        import_videos([video], session.path, ImportOptions())
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(SessionError, match="no empty folder"):
        import_videos([video], tmp_path, ImportOptions())
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_an_interrupted_import_leaves_a_readable_session_and_can_be_completed(
    video: Path, tmp_path: Path, session: Session
) -> None:
    def stop(stage: str, share: float) -> None:
        if stage == "writing frames" and share > 0.5:
            raise KeyboardInterrupt

    out = tmp_path / "S"
    with pytest.raises(KeyboardInterrupt):
        import_videos([video], out, ImportOptions(), stop)
    left = Session.open(out)
    assert left.status == "interrupted"
    assert 0 < len(left.frames) < len(session.frames)
    assert left.frames == session.frames[: len(left.frames)]
    done = import_videos([video], out, ImportOptions())
    assert (done.status, done.frames) == ("complete", session.frames)
    with pytest.raises(SessionError, match="holds a session already"):
        import_videos([video], out, ImportOptions())


def test_an_interruption_before_the_writing_leaves_nothing(video: Path, tmp_path: Path) -> None:
    def stop(stage: str, share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_videos([video], tmp_path / "S", ImportOptions(), stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_goes_from_nothing_to_all_in_every_stage(
    video: Path, flash_list: Path, tmp_path: Path
) -> None:
    told: dict[str, list[float]] = {}
    import_videos(
        [video],
        tmp_path / "S",
        ImportOptions(flash_list=flash_list),
        lambda stage, share: told.setdefault(stage, []).append(share),
    )
    assert list(told) == ["looking at every frame", "tagging", "writing frames"]
    for shares in told.values():
        assert shares == sorted(shares)
        assert shares[-1] > 0.99


# ---------------------------------------------------------------- faults


def test_no_flash_at_all_is_refused_and_leaves_nothing(film, tmp_path: Path) -> None:
    video = replace(film, seconds=3.0, flash_gain=0.0).write(tmp_path / "a.mp4")
    with pytest.raises(TaggingError):
        import_videos([video], tmp_path / "S", ImportOptions())
    assert not (tmp_path / "S").exists()


def test_a_flash_that_is_always_on_is_refused(film, tmp_path: Path) -> None:
    video = replace(film, seconds=3.0, first_flash_s=-1.0, on_s=30.0, period_s=100.0).write(
        tmp_path / "a.mp4"
    )
    with pytest.raises(TaggingError):
        import_videos([video], tmp_path / "S", ImportOptions())


def test_a_video_of_three_frames_is_refused(film, tmp_path: Path) -> None:
    video = replace(film, seconds=0.1).write(tmp_path / "a.mp4")
    with pytest.raises(TaggingError):
        import_videos([video], tmp_path / "S", ImportOptions())


def test_of_a_file_that_is_cut_off_the_beginning_is_imported_and_the_loss_named(
    video: Path, flash_list: Path, tmp_path: Path
) -> None:
    streamable = tmp_path / "streamable.mp4"
    with (
        av.open(str(video)) as source,
        av.open(str(streamable), "w", options={"movflags": "faststart"}) as target,
    ):
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    os.truncate(streamable, round(0.7 * streamable.stat().st_size))
    session = import_videos([streamable], tmp_path / "S", ImportOptions(flash_list=flash_list))
    assert 60 < len(session.frames) < 180
    assert any("is cut off or damaged" in warning for warning in session.info["warnings"])


def test_a_file_that_changes_between_the_passes_is_an_error(
    film, video: Path, flash_list: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "a.mp4"
    copy.write_bytes(video.read_bytes())
    other = replace(film, seconds=2.0).write(tmp_path / "b.mp4")

    def exchange(stage: str, share: float) -> None:
        if stage == "tagging":
            copy.write_bytes(other.read_bytes())

    with pytest.raises(SourceError, match="changed while it was read"):
        import_videos([copy], tmp_path / "S", ImportOptions(flash_list=flash_list), exchange)
    assert Session.open(tmp_path / "S").status == "interrupted"


@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ({"masks": Path("masks")}, "--masks is for image sets"),
        ({"kept_rate_hz": 0.0}, "positive --rate"),
        ({"kept_rate_hz": float("nan")}, "positive --rate"),
        ({"max_frames": 1}, "too few"),
    ],
)
def test_options_that_make_no_sense_for_a_video_are_refused(
    option: dict[str, object], complaint: str, video: Path, tmp_path: Path
) -> None:
    with pytest.raises(SourceError, match=complaint):
        import_videos([video], tmp_path / "S", ImportOptions(**option))  # type: ignore[arg-type]


# ---------------------------------------------------------------- poses


def poses_file(path: Path, times: list[float], size: tuple[int, int] = (192, 112), **extra: object) -> Path:
    frames = [
        {
            "index": k,
            "pts_s": time,
            "R": np.eye(3).tolist(),
            "t": [0.01 * k, 0, 0],
            "split": "val" if k % 5 == 0 else "train",
        }
        for k, time in enumerate(times)
    ]
    K = [[200, 0, 96], [0, 200, 56], [0, 0, 1]]
    content = {
        "name": "rig",
        "transfer": "rec709",
        "width": size[0],
        "height": size[1],
        "K": K,
        "frames": frames,
    }
    path.write_text(json.dumps(content | extra))
    return path


def test_poses_are_matched_by_time_and_kept_with_their_frames(film, video: Path, tmp_path: Path) -> None:
    # Every third frame has a pose, given to 5 ms: well within half of the frame interval of 33 ms.
    times = [round(time / 0.005) * 0.005 for time in film.times_s()[::3]]
    poses = poses_file(tmp_path / "cameras.json", times, flash={"offset_cam": [0.02, -0.01, 0.0]})
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 1 2\n"
    )
    options = ImportOptions(poses=poses, points=tmp_path / "points.ply")
    session = import_videos([video], tmp_path / "S", options)
    cameras = session.load_scene_cameras()
    posed = {record.index for record in kept(session) if record.index % 3 == 0}
    assert set(cameras) == posed
    for index, camera in cameras.items():
        np.testing.assert_allclose(camera.cam_from_world[:3, 3], [0.01 * (index // 3), 0, 0], atol=1e-12)
        assert session.frames[index].split == ("val" if index // 3 % 5 == 0 else "train")
    # A frame with a pose is preferred, so nearly all unlit frames that are kept have one.
    unlit = [record.index for record in kept(session) if record.flash == 0]
    assert np.mean([index % 3 == 0 for index in unlit]) > 0.9
    assert session.points_path.is_file()
    offset = json.loads(session.calibration_path.read_text())["flash_offset_cam_m"]
    assert (offset["value"], offset["unit"]) == ([0.02, -0.01, 0.0], "m")


def test_poses_of_another_time_or_size_or_without_times_are_refused(video: Path, tmp_path: Path) -> None:
    for times, size, complaint in (
        ([100.0, 101.0], (192, 112), "belongs to a frame"),
        ([0.1], (112, 192), r"112 x 192 pixels, the video 192 x 112"),
    ):
        poses = poses_file(tmp_path / "cameras.json", times, size)
        with pytest.raises(SourceError, match=complaint):
            import_videos([video], tmp_path / "S", ImportOptions(poses=poses))
    timeless = json.loads((tmp_path / "cameras.json").read_text())
    for frame in timeless["frames"]:
        del frame["pts_s"]
    (tmp_path / "cameras.json").write_text(json.dumps(timeless))
    with pytest.raises(SourceError, match="gives no pts_s"):
        import_videos([video], tmp_path / "S", ImportOptions(poses=tmp_path / "cameras.json"))
    assert not (tmp_path / "S").exists()
