"""Sidecars of Open Camera: what they say is read, what they hide stays hidden, garbage is one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import SourceError
from capture.importers.open_camera_settings import read_settings
from capture.importers.sidecars import find_sidecars, read_clock_log, read_subtitles, tie_frame_clock
from capture.transfer import canonical_transfer

Damage = Callable[[bytes], st.SearchStrategy[bytes]]

SUBTITLES = """1
00:00:00,000 --> 00:00:00,412
Nov 2, 2026 10:15:30 AM
52.5200, 13.4050, 34.5m, 270°

2
00:00:00,413 --> 00:00:01,412
Nov 2, 2026 10:15:31 AM
52.5200, 13.4050, 34.5m, 270°

3
00:00:01,413 --> 00:00:02,412
Nov 2, 2026 10:15:32 AM
52.5200, 13.4050, 34.5m, 270°
"""
FRAME_LOG = b"".join(b"%d\n" % (81_234_567_890_123 + 33_333_333 * k) for k in range(30))
GOOD_SETTINGS = {
    ("boolean", "preference_video_flash"): "true",
    ("string", "preference_camera_api"): "preference_camera_api_camera2",
    ("string", "preference_iso"): "200",
    ("long", "preference_exposure_time"): "5000000",
    ("string", "preference_white_balance"): "manual",
    ("int", "preference_white_balance_temperature"): "4800",
    ("string", "preference_video_log"): "srgb",
    ("boolean", "preference_record_audio"): "false",
    ("string", "focus_value_0_true"): "focus_mode_locked",
    ("string", "preference_save_location"): "/home/someone/private",
}


def settings_xml(changes: dict[tuple[str, str], str] | None = None) -> bytes:
    entries = {**GOOD_SETTINGS, **(changes or {})}
    lines = "".join(f'<{kind} key="{key}" value="{value}" />' for (kind, key), value in entries.items())
    head = "<?xml version='1.0' encoding='UTF-8' standalone='yes' ?>"
    return f"{head}<open_camera_prefs>{lines}</open_camera_prefs>".encode()


# ---------------------------------------------------------------- where they are


def test_sidecars_are_found_beside_the_video_and_in_its_dated_folder(tmp_path: Path) -> None:
    video = tmp_path / "VID_20261102_101530.mp4"
    folder = tmp_path / "20261102_101530"
    folder.mkdir()
    subtitles = tmp_path / "VID_20261102_101530.srt"
    flash = folder / "VID_20261102_101530_flash.csv"
    times = folder / "VID_20261102_101530_imu_timestamps.csv"
    old, new = tmp_path / "BACKUP_OC_20250101_000000.xml", tmp_path / "BACKUP_OC_20261101_120000.xml"
    for path in (video, subtitles, flash, times, old, new):
        path.touch()
    found = find_sidecars(video)
    assert (found.subtitles, found.flash_times, found.frame_times, found.settings) == (
        subtitles,
        flash,
        times,
        new,
    )


def test_a_video_without_sidecars_has_none(tmp_path: Path) -> None:
    (tmp_path / "other.srt").touch()
    found = find_sidecars(tmp_path / "holiday.mp4")
    assert {found.subtitles, found.flash_times, found.frame_times, found.settings} == {None}


# ---------------------------------------------------------------- subtitles


def test_subtitles_give_the_clock_and_keep_the_place_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    path.write_text(SUBTITLES)
    subtitles = read_subtitles(path)
    assert subtitles.cues == 3
    assert subtitles.end_s == pytest.approx(1.412)
    assert subtitles.clock_text == "Nov 2, 2026 10:15:30 AM"
    assert subtitles.place_text == "52.5200, 13.4050, 34.5m, 270°"
    assert "52.52" not in repr(subtitles)


@pytest.mark.parametrize(
    ("line", "is_clock"),
    [
        ("02.11.2026 10:15:30", True),
        ("2026/11/02 22:15", True),
        ("52,52000, 13,40500", False),
        ("52°31'12\"N, 13°24'18\"E", False),
        ("10:15:30 52.5200, 13.4050", False),
        ("Unter den Linden 1, 10117 Berlin", False),
    ],
)
def test_no_line_that_tells_the_place_passes_for_a_clock(line: str, is_clock: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    path.write_text(f"1\n00:00:00,000 --> 00:00:01,000\n{line}\n")
    assert read_subtitles(path).clock_text == (line if is_clock else None)


def test_subtitles_of_a_windows_editor_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    path.write_bytes(b"\xef\xbb\xbf" + SUBTITLES.replace("\n", "\r\n").encode())
    assert read_subtitles(path).cues == 3


def test_a_file_without_cues_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    path.write_text("hello\n\nworld\n")
    with pytest.raises(SourceError, match="no subtitle with a time"):
        read_subtitles(path)


# ---------------------------------------------------------------- clocks


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "no time stamps"),
        (b"\n\n", "no time stamps"),
        (b"12\n11\n", "line 2: the clock goes backwards"),
        (b"12\n12\n", "line 2: the clock goes backwards or stands still"),
        (b"time_ns\n1\n", "line 1: 'time_ns' is no time"),
        (b"1\n-5\n", "line 2: '-5' is no time"),
        (b"9223372036854775808\n", "line 1"),
        (b"1.5\n", "line 1"),
    ],
)
def test_a_clock_log_must_be_increasing_integers(content: bytes, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=complaint):
        read_clock_log(path)


def uneven_times(count: int, seed: int) -> np.ndarray:
    """Times of frames at about 30 Hz that wander, as a phone's do."""
    return 0.2 + np.cumsum(np.random.default_rng(seed).uniform(0.025, 0.045, count))


def clock_of(pts_s: np.ndarray, jitter_s: float = 0.0, seed: int = 0) -> np.ndarray:
    jitter = np.random.default_rng(seed).normal(0, jitter_s, len(pts_s)) if jitter_s else 0.0
    return np.round((pts_s + jitter) * 1e9).astype(np.int64) + 81_234_567_890_123


def test_the_clock_of_each_frame_is_found_to_its_jitter() -> None:
    pts_s = uneven_times(200, 1)
    clock = tie_frame_clock(clock_of(pts_s, jitter_s=1e-4), pts_s)
    assert clock is not None
    # The origin is a median of 200: its error is 1.25 jitter / sqrt(200), here taken fivefold.
    assert abs(clock.origin_ns - 81_234_567_890_123) < 5 * 1.25 * 1e5 / np.sqrt(200)
    assert None not in clock.frame_ns
    # The median of |N(0, 1)| is 0.674.
    assert clock.residual_s == pytest.approx(0.674e-4, rel=0.3)


@pytest.mark.parametrize(("before", "after"), [(3, 0), (0, 4), (2, 5)])
def test_a_log_may_start_before_and_end_after_the_video(before: int, after: int) -> None:
    times_s = uneven_times(100, 2)
    pts_s = times_s[before : 100 - after]
    clock = tie_frame_clock(clock_of(times_s), pts_s)
    assert clock is not None
    assert clock.frame_ns == tuple(clock_of(times_s)[before : 100 - after].tolist())


def test_frames_that_the_log_lacks_have_no_clock() -> None:
    pts_s = uneven_times(100, 3)
    logged = np.delete(clock_of(pts_s), [0, 1, 40])
    clock = tie_frame_clock(logged, pts_s)
    assert clock is not None
    assert [index for index, time in enumerate(clock.frame_ns) if time is None] == [0, 1, 40]


def test_at_a_constant_rate_the_first_frames_are_paired() -> None:
    pts_s = np.arange(100) / 30
    clock = tie_frame_clock(clock_of(pts_s), pts_s)
    assert clock is not None
    assert clock.frame_ns[0] == 81_234_567_890_123


def test_times_of_another_video_are_not_tied() -> None:
    pts_s = uneven_times(200, 4)
    assert tie_frame_clock(clock_of(np.arange(200) / 24), pts_s) is None
    assert tie_frame_clock(clock_of(uneven_times(300, 4)), pts_s) is None
    assert tie_frame_clock(clock_of(pts_s[:1]), pts_s) is None


# ---------------------------------------------------------------- settings


def test_settings_that_suit_the_capture_have_no_problem(tmp_path: Path) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    path.write_bytes(settings_xml())
    found = read_settings(path)
    assert found.problems == ()
    assert found.transfer == "srgb"
    assert found.exposure_s == pytest.approx(0.005)
    assert found.iso == 200
    assert found.flash_period_s == 1.0
    assert "/home/someone/private" not in str(found)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({("boolean", "preference_video_flash"): "false"}, "blinking flash is off"),
        ({("string", "preference_camera_api"): "preference_camera_api_old"}, "Camera2"),
        ({("string", "preference_iso"): "auto"}, "exposure is automatic"),
        ({("string", "preference_white_balance"): "auto"}, "white balance is automatic"),
        ({("boolean", "preference_video_stabilization"): "true"}, "stabilisation is on"),
        ({("string", "preference_video_log"): "off"}, "tone curve is unknown"),
        ({("boolean", "preference_record_audio"): "true"}, "sound is recorded"),
        ({("string", "focus_value_0_true"): "focus_mode_continuous_video"}, "focus is automatic"),
    ],
)
def test_each_harmful_setting_is_one_problem(
    change: dict[tuple[str, str], str], problem: str, tmp_path: Path
) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    path.write_bytes(settings_xml(change))
    problems = read_settings(path).problems
    assert len(problems) == 1
    assert problem in problems[0]


@pytest.mark.parametrize(
    ("profile", "gamma", "transfer"),
    [
        ("rec709", "2.2", "rec709"),
        ("fine", "2.2", "log:10@64"),
        ("extra_strong", "2.2", "log:500@64"),
        ("gamma", "1.8", "gamma:1.8@64"),
        ("jtlog2", "2.2", "jtlog2"),
        ("off", "2.2", None),
        ("gamma", "nonsense", None),
        ("new_profile", "2.2", None),
    ],
)
def test_the_picture_profile_names_the_transfer(
    profile: str, gamma: str, transfer: str | None, tmp_path: Path
) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    change = {
        ("string", "preference_video_log"): profile,
        ("string", "preference_video_profile_gamma"): gamma,
    }
    path.write_bytes(settings_xml(change))
    found = read_settings(path).transfer
    assert found == transfer
    if found is not None:
        assert canonical_transfer(found) == found


def test_an_empty_export_means_the_apps_defaults(tmp_path: Path) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    path.write_bytes(b"<open_camera_prefs/>")
    found = read_settings(path)
    assert found.exposure_s is None
    assert found.flash_period_s is None
    assert any("flash is off" in problem for problem in found.problems)


def test_the_period_of_opencamera_sensors_is_read(tmp_path: Path) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    path.write_bytes(settings_xml({("string", "preference_strobe_freq"): "750"}))
    assert read_settings(path).flash_period_s == 0.75


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "no valid XML"),
        (b"<a>", "no valid XML"),
        (b"<preferences/>", "no settings file of Open Camera"),
        (b'<!DOCTYPE a [<!ENTITY b "b">]><open_camera_prefs/>', "declares document types or entities"),
        (b'<?xml version="1.0" encoding="no-such"?><open_camera_prefs/>', "no valid XML"),
    ],
)
def test_other_xml_is_refused(content: bytes, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "BACKUP_OC_1.xml"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=complaint):
        read_settings(path)


# ---------------------------------------------------------------- garbage


@pytest.mark.parametrize(
    ("reader", "content"),
    [(read_subtitles, SUBTITLES.encode()), (read_clock_log, FRAME_LOG), (read_settings, settings_xml())],
    ids=["srt", "csv", "xml"],
)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_sidecars_are_read_or_refused(
    reader: Callable[[Path], object], content: bytes, data: st.DataObject, damage: Damage, scratch: Path
) -> None:
    path = scratch / "BACKUP_OC_damaged"
    path.write_bytes(data.draw(damage(content)))
    try:
        reader(path)
    except SourceError as error:
        sentence = str(error)
    else:
        sentence = "read."
    assert sentence.endswith(".")


@pytest.mark.parametrize("reader", [read_subtitles, read_clock_log, read_settings])
def test_a_missing_sidecar_is_named(reader: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="none cannot be read"):
        reader(tmp_path / "none")
