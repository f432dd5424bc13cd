"""A recording as a camera: its own times, nothing that can be set, an end that is no failure."""

from pathlib import Path

import numpy as np
import pytest

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.replay import ReplayCamera, list_cameras, open_camera
from capture.devices.table import open_camera as open_camera_url
from capture.errors import CameraEndedError, CameraError, CameraGoneError, CameraTimeoutError
from capture.images import write_jpeg, write_png
from capture.video import VideoWriter

WIDTH, HEIGHT = 64, 48
#: Of a phone's video: late, early, with a frame missing after the third.
VIDEO_TIMES_S = (0.0, 0.0334, 0.0665, 0.1333, 0.1668)


def grey(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Frames 1..12 whose value is ten times their number; 10 comes after 9, not after 1."""
    pictures = tmp_path / "frames"
    pictures.mkdir()
    for number in range(1, 13):
        write_png(pictures / f"frame_{number}.png", grey(10 * number))
    return pictures


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "VID_1.mp4"
    with VideoWriter(path, WIDTH, HEIGHT, crf=1, rotation_deg=90, transfer="srgb") as writer:
        for index, pts_s in enumerate(VIDEO_TIMES_S):
            writer.write(grey(40 * index + 20), pts_s)
    return path


def opened(rest: object, bench: Bench | None = None, **profile: float) -> ReplayCamera:
    camera = open_camera(str(rest), bench or Bench(VirtualClock()))
    camera.lock(CameraProfile(**profile))  # type: ignore[arg-type]
    return camera


def all_frames(camera: ReplayCamera) -> list:
    frames = []
    while True:
        try:
            frames.append(camera.read(1.0))
        except CameraEndedError:
            return frames


def test_the_pictures_of_a_folder_come_in_natural_order_at_even_times(folder: Path) -> None:
    with opened(f"{folder};rate=fast;fps=25") as camera:
        frames = all_frames(camera)
        assert camera.ended
    assert [int(frame.data[0, 0, 0]) for frame in frames] == [10 * number for number in range(1, 13)]
    assert [frame.sequence for frame in frames] == list(range(12))
    assert [frame.stamp_s for frame in frames] == pytest.approx([index / 25 for index in range(12)])


def test_a_video_keeps_its_own_times_rotation_and_transfer(video: Path) -> None:
    with opened(f"{video};rate=fast") as camera:
        assert (camera.info.clock, camera.format.rotation_deg, camera.format.transfer) == ("own", 90, "srgb")
        frames = all_frames(camera)
    # The mp4 counts 1/90000 s.
    assert [frame.stamp_s for frame in frames] == pytest.approx(VIDEO_TIMES_S, abs=1 / 90000)
    assert frames[0].data.shape == (HEIGHT, WIDTH, 3)
    # Limited-range luma has 219 steps for 255 values, and the encoder at crf 1 adds a step.
    assert [frame.data.mean() for frame in frames] == pytest.approx([20, 60, 100, 140, 180], abs=2)


def test_fast_replay_takes_no_time_of_the_bench(folder: Path) -> None:
    bench = Bench(VirtualClock())
    start_s = bench.clock.now_s()
    assert len(all_frames(opened(f"{folder};rate=fast", bench))) == 12
    assert bench.clock.now_s() == start_s


def test_real_time_replay_hands_frames_over_when_they_are_due(video: Path) -> None:
    bench = Bench(VirtualClock())
    frames = all_frames(opened(video, bench))
    arrivals_s = np.array([frame.arrival_s for frame in frames])
    # Exact but for the rounding of sums of doubles around 100 s.
    np.testing.assert_allclose(arrivals_s - arrivals_s[0], VIDEO_TIMES_S, atol=1 / 90000 + 1e-9)


def test_a_frame_that_is_due_later_than_the_timeout_is_not_lost(folder: Path) -> None:
    bench = Bench(VirtualClock())
    camera = opened(f"{folder};fps=2", bench)
    assert camera.read(0.1).sequence == 0
    start_s = bench.clock.now_s()
    with pytest.raises(CameraTimeoutError, match=r"within 0\.1 s"):
        camera.read(0.1)
    assert bench.clock.now_s() - start_s == pytest.approx(0.1)
    assert camera.read(0.5).sequence == 1


def test_a_reader_that_was_late_catches_up(folder: Path) -> None:
    bench = Bench(VirtualClock())
    camera = opened(f"{folder};fps=10", bench)
    camera.read(1.0)
    bench.clock.sleep(0.55)
    late_s = bench.clock.now_s()
    arrivals_s = [camera.read(1.0).arrival_s - late_s for _ in range(6)]
    assert arrivals_s == pytest.approx([0, 0, 0, 0, 0, 0.05])


def test_loops_go_on_with_stamps_and_sequence(folder: Path) -> None:
    frames = all_frames(opened(f"{folder};rate=fast;loop=2;fps=20"))
    assert [frame.sequence for frame in frames] == list(range(36))
    np.testing.assert_allclose(np.diff([frame.stamp_s for frame in frames]), 1 / 20)


def test_a_loop_without_end_goes_on(folder: Path) -> None:
    camera = opened(f"{folder};rate=fast;loop=forever")
    assert [camera.read(1.0).sequence for _ in range(30)] == list(range(30))


def test_what_cannot_be_set_is_reported_as_such(folder: Path) -> None:
    camera = open_camera(str(folder), Bench(VirtualClock()))
    report = camera.lock(CameraProfile(exposure_s=0.005, gain=3, fps=60, width=640, height=480))
    exposure, gain, fps = report.controls
    assert (exposure.name, exposure.requested, exposure.read_back) == ("exposure_s", 0.005, None)
    assert exposure.verified is None
    assert gain.note == "a recording cannot be set"
    assert (fps.requested, fps.read_back, fps.note) == (60, 30.0, "a recording cannot be set")
    assert any("64 x 48" in warning and "640 x 480" in warning for warning in report.warnings)
    assert any("no times" in warning for warning in report.warnings)
    assert "exposure_s: a recording cannot be set." in report.warnings
    assert camera.check() == ()
    assert camera.restore() == ()


def test_a_picture_that_cannot_be_read_is_a_gap_in_the_sequence(folder: Path) -> None:
    broken = folder / "frame_4.png"
    broken.write_bytes(broken.read_bytes()[:60])
    frames = all_frames(opened(f"{folder};rate=fast"))
    assert [frame.sequence for frame in frames] == [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11]


def test_pictures_of_two_sizes_are_refused_by_name_each_time(folder: Path) -> None:
    write_png(folder / "frame_2.png", np.zeros((8, 8, 3), np.uint8))
    camera = opened(f"{folder};rate=fast")
    camera.read(1.0)
    for _ in range(2):
        with pytest.raises(CameraError, match=r"frame_2\.png has 8 x 8 pixels") as caught:
            camera.read(1.0)
        assert not isinstance(caught.value, CameraGoneError)
    assert not camera.ended


def test_grey_pictures_become_rgb(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", np.full((16, 24), 77, np.uint8))
    data = opened(f"{tmp_path};rate=fast").read(1.0).data
    assert np.shape(data) == (16, 24, 3)
    assert np.ptp(data) == 0


def test_sixteen_bits_stay_sixteen(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.full((8, 8, 3), 40000, np.uint16))
    assert opened(f"{tmp_path};rate=fast").read(1.0).data[0, 0, 0] == 40000  # type: ignore[call-overload]


def test_it_plays_only_between_lock_and_close(folder: Path) -> None:
    camera = open_camera(str(folder), Bench(VirtualClock()))
    with pytest.raises(CameraError, match="lock it first"):
        camera.read(1.0)
    camera.lock(CameraProfile())
    camera.close()
    camera.close()
    with pytest.raises(CameraGoneError, match="is closed"):
        camera.read(1.0)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ("rate=slow", "it is real or fast"),
        ("loop=-1", "a number of times, or forever"),
        ("fps=0", "positive number"),
        ("fps=nan", "positive number"),
        ("fps=many", "no float"),
        ("speed=2", "known are rate=..., loop=..., fps=..."),
    ],
)
def test_settings_that_are_not_understood_are_named(folder: Path, settings: str, sentence: str) -> None:
    with pytest.raises(CameraError, match=sentence.replace(".", r"\.")):
        open_camera(f"{folder};{settings}", Bench())


def test_what_is_no_recording_is_refused_in_one_sentence(tmp_path: Path, video: Path) -> None:
    with pytest.raises(CameraError, match="does not exist"):
        open_camera(str(tmp_path / "none"), Bench())
    with pytest.raises(CameraError, match="does not exist"):
        open_camera("", Bench())
    with pytest.raises(CameraError, match="no PNG or JPEG"):
        open_camera(str(tmp_path), Bench())
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with pytest.raises(CameraError, match=r"film\.mp4 cannot be read"):
        open_camera(str(tmp_path / "film.mp4"), Bench())
    with pytest.raises(CameraError, match="has its own times"):
        open_camera(f"{video};fps=30", Bench())


def test_it_is_opened_by_its_url_and_listed_nowhere(folder: Path) -> None:
    camera = open_camera_url(f"replay:{folder};rate=fast")
    assert camera.info.back_end == "replay"
    assert list_cameras() == ()
