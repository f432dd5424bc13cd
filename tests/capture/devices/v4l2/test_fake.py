"""The fake driver is what it says: light, lamp, latency, buffers, settings by URL."""

import numpy as np
import pytest

from capture.devices.bench import Bench, LampLight, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.light_check import linear_luma, mean_light
from capture.devices.table import open_camera
from capture.devices.v4l2.fake import list_cameras, parse
from capture.devices.v4l2.fake_quirks import PROFILES
from capture.errors import CameraError

READOUT_S = 0.020


def light(camera, frames=12):
    return float(mean_light(lambda: camera.read(1.0), lambda: camera.format, frames).mean())


@pytest.mark.parametrize("pixel_format", ["YUYV", "NV12", "MJPG", "RGGB", "RG10"])
def test_light_is_exposure_times_gain_in_every_format(pixel_format):
    with open_camera("fake-v4l2:width=64;height=48", Bench(VirtualClock())) as camera:
        profile = {"width": 64, "height": 48, "pixel_format": pixel_format, "white_balance_k": 4000}
        camera.lock(CameraProfile(**profile, exposure_s=0.004, gain=0))
        short = light(camera)
        camera.lock(CameraProfile(**profile, exposure_s=0.008, gain=0))
        assert light(camera) / short == pytest.approx(2.0, rel=0.03)  # 8-bit codes of a dark picture
        camera.lock(CameraProfile(**profile, exposure_s=0.004, gain=64))
        assert light(camera) / short == pytest.approx(2.0, rel=0.03)


def test_the_lamp_lights_the_rows_that_expose_while_it_is_on():
    bench = Bench(VirtualClock(), LampLight())
    with open_camera("fake-v4l2:width=64;height=48", bench) as camera:
        camera.lock(CameraProfile(width=64, height=48, exposure_s=0.004, gain=0, white_balance_k=4000))
        dark = linear_luma(camera.read(1.0), camera.format)
        face = np.s_[14:34, 24:40]
        now_s = bench.clock.now_s()
        bench.light.pulses.append((now_s + 0.300, now_s + 0.400))
        for _ in range(20):
            frame = camera.read(1.0)
            ratio = (linear_luma(frame, camera.format) / dark)[face].mean(axis=1)
            rows = frame.stamp_s + (np.arange(14, 34) + 0.5) / 48 * READOUT_S
            overlap = np.minimum(rows + 0.004, now_s + 0.4) - np.maximum(rows, now_s + 0.3)
            lit = np.clip(overlap / 0.004, 0, 1)
            assert (ratio[lit == 1] > 1.5).all()
            assert (ratio[lit == 0] < 1.2).all()  # noise of a dark picture, mean of 16 pixels


def test_frames_that_nobody_fetches_are_lost_and_counted():
    bench = Bench(VirtualClock())
    with open_camera("fake-v4l2:width=64;height=48", bench) as camera:
        camera.lock(CameraProfile(width=64, height=48, exposure_s=0.01))
        before = camera.read(1.0).sequence
        bench.clock.sleep(1.0)  # thirty frames, eight buffers
        sequences = [camera.read(1.0).sequence for _ in range(12)]
        assert sequences[:8] == list(range(before + 1, before + 9))
        assert sequences[8] >= before + 29


def test_every_profile_can_be_opened_and_names_its_settings():
    for name in PROFILES:
        quirks, seed = parse(f"profile={name};seed=4;width=64;height=48")
        assert seed == 4
        assert all(sizes == (((64, 48), (30.0, 15.0)),) for _, sizes in quirks.modes)
    assert parse("lost_every=7;stale_cache")[0].lost_every == 7
    assert parse("stale_cache")[0].stale_cache is True
    assert list_cameras() == ()


@pytest.mark.parametrize(
    ("description", "words"),
    [
        ("profile=webcam", "no profile 'webcam'; known are plain, c920"),
        ("speed=3", "'speed=3'; known are profile=..., seed=..."),
        ("seed=x", "seed is 'x'"),
        ("width=64", "must both be given"),
        ("width=63;height=48", "even"),
    ],
)
def test_a_description_that_is_not_understood_lists_what_is(description, words):
    with pytest.raises(CameraError) as failed:
        parse(description)
    assert words in str(failed.value)


def test_the_same_seed_gives_the_same_frames():
    def frames(seed):
        with open_camera(f"fake-v4l2:width=64;height=48;seed={seed}", Bench(VirtualClock())) as camera:
            camera.lock(CameraProfile(width=64, height=48, exposure_s=0.01))
            return [camera.read(1.0).data for _ in range(3)]

    assert frames(1) == frames(1)
    assert frames(1) != frames(2)
