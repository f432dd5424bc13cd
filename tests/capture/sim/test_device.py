"""The simulated camera and flash: what they model is there, and accidents happen when they are asked for."""

import numpy as np
import pytest

from capture.devices.bench import Bench, MonotonicClock
from capture.devices.camera import CameraProfile, KnowsScene
from capture.devices.flash import PulseTrain
from capture.devices.table import open_bench, open_camera, open_flash
from capture.errors import CameraError, CameraGoneError, FlashError, FlashGoneError, FlashResetError
from capture.transfer import to_linear


@pytest.fixture(autouse=True)
def quickly(one_rig):
    pass


@pytest.fixture
def bench():
    """So slow a walk that the scene stands still."""
    return open_bench("sim:coarse", "sim:", 4000.0)


@pytest.fixture
def camera(bench):
    with open_camera("sim:coarse", bench) as camera:
        yield camera


def level(frame):
    return (frame.data.astype(float) / 255) ** 2.2


def test_time_passes_by_reading_and_frames_are_evenly_stamped(bench, camera):
    camera.lock(CameraProfile())
    before_s = bench.clock.now_s()
    stamps = [camera.read(1.0).stamp_s for _ in range(30)]
    assert bench.clock.now_s() - before_s == pytest.approx(29 / 30, abs=0.05)
    # The sensor's own jitter is 0.4 ms.
    np.testing.assert_allclose(np.diff(stamps), 1 / 30, atol=0.004)


def test_frames_are_lit_when_the_flash_says_so(bench, camera):
    flash = open_flash("sim:", bench)
    camera.lock(CameraProfile())
    start_s = bench.clock.now_s() + 0.3
    flash.start(PulseTrain(start_s=start_s, period_s=1.0, on_s=0.1, count=2))
    frames = [camera.read(1.0) for _ in range(45)]
    lights = np.array([level(frame).mean() for frame in frames])
    times = np.array([frame.stamp_s for frame in frames]) - start_s
    # A frame takes 20 ms of readout and 8 ms of exposure.
    inside = ((times > 0.002) & (times < 0.07)) | ((times > 1.002) & (times < 1.07))
    outside = (times < -0.03) | ((times > 0.102) & (times < 0.97)) | (times > 1.102)
    assert lights[inside].min() > 1.15 * lights[outside].max()
    edges = flash.poll()
    assert [(edge.on, edge.pulse) for edge in edges] == [(True, 0), (False, 0), (True, 1), (False, 1)]
    np.testing.assert_allclose([edge.time_s - start_s for edge in edges], [0, 0.1, 1, 1.1], atol=1e-9)


def test_off_ends_the_pulse_that_burns_and_those_to_come(bench):
    flash = open_flash("sim:", bench)
    start_s = bench.clock.now_s()
    flash.start(PulseTrain(start_s=start_s, on_s=0.2, count=5))
    bench.clock.sleep(0.1)
    assert flash.off()
    assert flash.off()
    assert [off - start_s for _, off in bench.light.pulses] == [pytest.approx(0.1)]
    bench.clock.sleep(10)
    edges = flash.poll()
    assert [edge.on for edge in edges] == [True, False]
    assert edges[1].time_s - start_s == pytest.approx(0.1)


def test_half_the_exposure_is_half_the_light(bench, camera):
    pictures = []
    for exposure_s in (0.008, 0.004):
        report = camera.lock(CameraProfile(exposure_s=exposure_s))
        assert report.value("exposure_s") == exposure_s
        pictures.append(camera.read(1.0).data)
    full, half = (to_linear(picture / np.float32(255), "srgb") for picture in pictures)
    sound = (pictures[0] < 250) & (pictures[0] > 20)
    # Noise averages out over some thousand pixels.
    assert half[sound].mean() / full[sound].mean() == pytest.approx(0.5, abs=0.01)


def test_a_control_beyond_its_range_is_clamped_and_said(camera):
    report = camera.lock(CameraProfile(exposure_s=1.0))
    assert report.value("exposure_s") == 0.03
    assert "clamped to 0.03" in report.warnings[0]


def test_it_knows_its_poses_and_cloud_unless_it_keeps_them(bench, camera):
    camera.lock(CameraProfile())
    assert isinstance(camera, KnowsScene)
    assert camera.read(1.0).camera is not None
    assert len(camera.known_scene().cloud.points) > 1000
    with open_camera("sim:coarse;unposed", bench) as quiet:
        quiet.lock(CameraProfile())
        assert quiet.read(1.0).camera is None
        assert quiet.known_scene() is None


def test_lost_frames_are_gaps_in_the_sequence(bench):
    with open_camera("sim:coarse;drop=0.3", bench) as camera:
        camera.lock(CameraProfile())
        sequence = [camera.read(1.0).sequence for _ in range(60)]
    # 0.3 of 60 / 0.7 frames are lost; the chance of fewer than ten gaps is below 1e-4.
    assert sequence[-1] - sequence[0] - 59 >= 10
    assert np.all(np.diff(sequence) > 0)


def test_a_camera_that_is_unplugged_is_gone_and_one_that_drifts_is_told(bench):
    with open_camera("sim:coarse;unplug_s=0.5;drift_s=0.2", bench) as camera:
        camera.lock(CameraProfile())
        assert camera.check() == ()
        for _ in range(14):  # half a second, but for the jitter of the stamps
            camera.read(1.0)
        with pytest.raises(CameraGoneError, match="unplugged"):
            [camera.read(1.0) for _ in range(3)]
        assert [control.name for control in camera.check()] == ["exposure_s"]
        camera.restore()
        assert camera.check() == ()


@pytest.mark.parametrize(("fault", "error"), [("unplug_s", FlashGoneError), ("reset_s", FlashResetError)])
def test_a_flash_that_fails_is_dark_and_says_so_at_the_next_poll(bench, fault, error):
    flash = open_flash(f"sim:{fault}=1.5", bench)
    start_s = bench.clock.now_s() + 0.1
    flash.start(PulseTrain(start_s=start_s, count=10))
    bench.clock.sleep(3.0)
    assert len(flash.poll()) == 4
    with pytest.raises(error):
        flash.poll()
    assert all(off <= start_s + 1.5 for _, off in bench.light.pulses)
    assert flash.off() is False


def test_settings_that_are_not_understood_are_refused(bench):
    with pytest.raises(CameraError, match="known are seed="):
        open_camera("sim:sed=3", bench)
    with pytest.raises(CameraError, match="no int"):
        open_camera("sim:seed=x", bench)
    with pytest.raises(FlashError, match="missed="):
        open_flash("sim:brightness=3", bench)
    with pytest.raises(CameraError, match="real time"):
        open_camera("sim:coarse;edges=/nowhere", bench)


def test_a_lamp_in_another_process_lights_the_camera_through_a_file(tmp_path):
    bench = Bench(MonotonicClock(), walk_s=4.0)
    path = tmp_path / "edges"
    now_ns = round(bench.clock.now_s() * 1e9)
    # On for all of the first three frames or so, off after; its time has come far enough for all of them.
    lines = [f"{now_ns} 1", f"{now_ns + 3 * 10**9} 0", f"{now_ns + 60 * 10**9} t", ""]
    path.write_text("\n".join(lines))
    with open_camera(f"sim:coarse;fps=10;edges={path}", bench) as camera:
        camera.lock(CameraProfile())
        lit = level(camera.read(5.0)).mean()
    with open_camera("sim:coarse;fps=10", bench) as camera:
        camera.lock(CameraProfile())
        unlit = level(camera.read(5.0)).mean()
    assert lit > 1.1 * unlit


def test_an_edge_file_that_is_missing_or_torn_is_told(tmp_path):
    bench = Bench(MonotonicClock())
    with pytest.raises(CameraError, match="no lamp writes"):
        open_camera(f"sim:coarse;edges={tmp_path / 'none'}", bench)
    path = tmp_path / "edges"
    path.write_text("nonsense\n")
    with open_camera(f"sim:coarse;edges={path}", bench) as camera:
        camera.lock(CameraProfile())
        with pytest.raises(CameraError, match="no edge of a lamp"):
            camera.read(1.0)
