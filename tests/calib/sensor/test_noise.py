"""Dark level and noise of a sensor are found again, with their uncertainty; bad pictures are refused."""

import numpy as np
import pytest

from calib.calibration import load_calibration
from calib.errors import NoiseError
from calib.sensor.noise import fit_dark, fit_noise
from calib.stills import Still
from capture.images import write_png
from capture.response import Response
from capture.sim.sensor import SensorConfig
from capture.transfer import to_display
from relight.cli import main

LEVELS = (0.004, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)


def ramp(seed, height=150, width=200):
    """[H, W, 3] a wall that gets brighter to the right, with a grain of its own."""
    grain = np.random.default_rng(seed).standard_normal((height, width))
    x = np.arange(width) / width
    return ((0.4 + 0.6 * x) * (1 + 0.03 * grain))[..., None] * np.array([0.8, 1.0, 0.6])


def shots(seed=0, sensor=None, levels=LEVELS):
    """Two pictures at each level, in turn."""
    sensor = sensor or SensorConfig(seed=seed)
    wall = ramp(seed)
    return [
        Still(f"{level}, {k}", sensor.develop(level * wall, 2 * number + k), None)
        for number, level in enumerate(levels)
        for k in range(2)
    ]


def dark_shots(pedestal=0.03, sigma=0.004, count=4, seed=0):
    """Dark pictures of a linear camera whose black is not cut off, with fixed rows and hot pixels."""
    rng = np.random.default_rng(seed)
    fixed = 0.001 * rng.standard_normal((150, 1, 3)) + 0.5 * (rng.random((150, 200, 1)) > 0.999)
    stored = [pedestal + fixed + sigma * rng.standard_normal((150, 200, 3)) for _ in range(count)]
    return [
        Still(f"dark {k}", np.rint(255 * np.clip(s, 0, 1)).astype(np.uint8), None)
        for k, s in enumerate(stored)
    ]


@pytest.mark.parametrize(
    ("transfer", "well_e", "read_e"), [("srgb", 6000.0, 3.0), ("srgb", 2000.0, 8.0), ("log:100", 6000.0, 5.0)]
)
def test_the_noise_of_a_known_sensor_is_found_again(transfer, well_e, read_e):
    off = []
    for seed in range(3):
        sensor = SensorConfig(transfer=transfer, seed=seed, full_well_e=well_e, read_noise_e=read_e)
        noise = fit_noise(shots(seed, sensor), Response(transfer))
        off += [(noise.read - read_e / well_e) / noise.read_sigma]
        off += [(noise.shot - 1 / well_e) / noise.shot_sigma]
        assert noise.shot == pytest.approx(1 / well_e, rel=0.03)  # 3.5 standard deviations
        assert noise.read == pytest.approx(read_e / well_e, rel=0.12)  # likewise
        assert noise.pairs == len(LEVELS)
        assert not noise.warnings
    # 18 numbers: rms 1 +- 0.17.
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.6


def test_fixed_pattern_and_flicker_are_no_noise():
    sensor = SensorConfig(seed=1)
    wall = ramp(1) * np.random.default_rng(2).uniform(0.8, 1.0, (150, 200, 1))
    pictures = [
        Still(str(k), sensor.develop(level * wall * (1 + 0.02 * (k % 2)), k), None)
        for k, level in enumerate(np.repeat(LEVELS, 2))
    ]
    noise = fit_noise(pictures, Response("srgb"))
    assert noise.shot == pytest.approx(1 / 6000, rel=0.04)


def test_the_dark_level_and_the_noise_at_black_of_a_camera_that_keeps_black():
    darks = dark_shots()
    dark = fit_dark(darks)
    assert not dark.cut
    # Of 255: rounding 0.05, rows of 0.001 / sqrt(150) = 0.02.
    assert 255 * dark.level == pytest.approx(255 * 0.03, abs=0.2)
    assert (np.abs(dark.level - 0.03) < 4 * dark.sigma).all()
    rng = np.random.default_rng(1)
    flats = []
    for k, level in enumerate(np.repeat((0.02, 0.1, 0.4, 0.8), 2)):
        signal = level * ramp(0) * 0.97
        noisy = 0.03 + signal + np.sqrt(0.004**2 + signal / 1500) * rng.standard_normal(signal.shape)
        flats.append(Still(f"flat {k}", np.rint(255 * np.clip(noisy, 0, 1)).astype(np.uint8), None))
    noise = fit_noise(flats, Response("linear"), dark.level, darks)
    assert noise.read == pytest.approx(0.004, rel=0.02)
    assert noise.shot == pytest.approx(1 / 1500, rel=0.04)


def test_black_that_is_cut_off_is_told():
    sensor = SensorConfig(seed=3)
    darks = [Still(str(k), sensor.develop(np.zeros((120, 160, 3)), k), None) for k in range(3)]
    dark = fit_dark(darks)
    assert dark.cut
    assert (dark.level == 0).all()  # a mean would say 0.7 of 255
    assert "cuts off black" in dark.warnings[0]


def _plain(value, count=2):
    return [Still(f"p{k}", np.full((120, 160, 3), value, np.uint8), None) for k in range(count)]


def _leak():
    shade = np.linspace(0, 12, 160)[None, :, None] + np.zeros((120, 160, 3))
    return [Still(f"p{k}", shade.astype(np.uint8), None) for k in range(2)]


@pytest.mark.parametrize(
    ("darks", "words"),
    [
        (lambda: dark_shots(count=1), "at least 2"),
        (lambda: _plain(90), "not dark"),
        (_leak, "not evenly dark"),
        (lambda: [*_plain(2), Still("x", np.zeros((50, 50, 3), np.uint8), None)], "different sizes"),
    ],
)
def test_dark_pictures_that_are_none_are_refused(darks, words):
    with pytest.raises(NoiseError, match=words):
        fit_dark(darks())


def _moved():
    return [
        Still(still.name, np.roll(still.image, 40 * (k % 2), axis=1), None)
        for k, still in enumerate(shots(levels=(0.05, 0.1, 0.3, 0.6)))
    ]


@pytest.mark.parametrize(
    ("stills", "words"),
    [
        (lambda: shots()[::2], "no two that follow each other"),
        (_moved, "moved"),
        (lambda: shots(levels=(2.5, 3.0)), "neither black nor white"),
        (lambda: _plain(90), "neither black nor white"),
        (lambda: shots(levels=(0.6,)), "cannot be told apart"),
        (lambda: shots(levels=(0.01, 0.02)), "cannot be told apart"),
    ],
)
def test_pairs_that_tell_no_noise_are_refused(stills, words):
    with pytest.raises(NoiseError, match=words):
        fit_noise(stills(), Response("srgb"))


def test_noise_that_a_camera_smooths_is_told():
    def smooth(still):
        linear = still.image.astype(np.float32) / 255
        return Still(still.name, np.rint(255 * (linear + np.roll(linear, 1, 1)) / 2).astype(np.uint8), None)

    noise = fit_noise([smooth(still) for still in shots()], Response("srgb"))
    assert noise.correlation == pytest.approx(0.5, abs=0.1)  # of a mean of two neighbours
    assert "goes together" in noise.warnings[0]


def test_the_command_saves_what_it_finds(tmp_path, capsys, read_page):
    for kind, stills in (("dark", dark_shots()), ("pairs", shots())):
        (tmp_path / kind).mkdir()
        for number, still in enumerate(stills):
            write_png(tmp_path / kind / f"{number:03d}.png", still.image)
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "dark", str(tmp_path / "dark"), "--out", str(out)]) == 0
    assert "dark level" in capsys.readouterr().out
    assert load_calibration(out).dark.value == pytest.approx(0.03, abs=0.001)
    other = tmp_path / "other.json"
    assert main(["calibrate", "dark", "--flats", str(tmp_path / "pairs"), "--out", str(other)]) == 0
    assert "photon transfer" in read_page(other)
    assert "white is" in capsys.readouterr().out
    assert load_calibration(other).noise_shot.value == pytest.approx(1 / 6000, rel=0.03)
    assert main(["calibrate", "dark", "--out", str(out)]) == 1
    assert main(["calibrate", "dark", str(tmp_path / "pairs"), "--out", str(other)]) == 1
    assert "not evenly dark" in capsys.readouterr().err


def test_the_transfer_functions_of_sensor_and_response_are_inverse():
    # What the other tests rest on: a code's radiance is in the middle of what became that code.
    x = np.linspace(0.001, 0.999, 500)
    codes = np.rint(255 * to_display(x, "srgb")).astype(np.uint8)
    back = Response("srgb").to_linear(codes[:, None].repeat(3, axis=1))[:, 0]
    assert np.abs(back - x).max() < 0.005  # half a code at white, where the slope is 2.28 / 255
