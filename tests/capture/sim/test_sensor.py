import numpy as np
import pytest

from capture.sim.sensor import SensorConfig
from capture.transfer import to_linear


@pytest.mark.parametrize("level", [0.05, 0.3, 0.8])
def test_the_noise_has_the_configured_deviation(level: float) -> None:
    sensor = SensorConfig(full_well_e=5000, read_noise_e=8)
    picture = sensor.linear(np.full((200, 200, 3), level), index=3)
    quantisation = (1 / 3839) ** 2 / 12
    expected = np.sqrt(level / 5000 + (8 / 5000) ** 2 + quantisation)
    # 120,000 samples give the deviation to 0.2 %; 1 % is five times that.
    assert picture.std() == pytest.approx(expected, rel=0.01)
    assert picture.mean() == pytest.approx(level, abs=5 * expected / np.sqrt(picture.size))


def test_without_noise_only_the_converters_steps_remain() -> None:
    ramp = np.linspace(0, 1, 5000).reshape(1, -1, 1)
    picture = SensorConfig(noise=False).linear(ramp, index=0)
    assert np.abs(picture - ramp).max() <= 0.5 / 3839 + 1e-6  # half a step, and float32


def test_light_above_white_clips_and_below_black_is_black() -> None:
    picture = SensorConfig(noise=False).develop(np.array([[[2.0, 1.0, -0.1]]]), index=0)
    assert picture.tolist() == [[[255, 255, 0]]]


def test_a_stored_picture_decodes_to_its_radiance_within_half_a_code() -> None:
    radiance = np.linspace(0.0, 1.0, 300).reshape(10, 10, 3)
    for transfer in ("srgb", "rec709"):
        stored = SensorConfig(transfer=transfer).encode(radiance)
        step = np.gradient(to_linear(np.arange(256, dtype=np.uint8), transfer)).max()
        assert np.abs(to_linear(stored, transfer) - radiance).max() <= 0.5 * step + 1e-6


def test_frames_have_independent_noise_that_repeats_with_the_seed() -> None:
    grey = np.full((20, 20, 3), 0.4)
    sensor = SensorConfig(seed=5)
    assert np.array_equal(sensor.linear(grey, 1), sensor.linear(grey, 1))
    assert not np.array_equal(sensor.linear(grey, 1), sensor.linear(grey, 2))
    assert not np.array_equal(sensor.linear(grey, 1), SensorConfig(seed=6).linear(grey, 1))


def test_flicker_is_the_mains_wave_averaged_over_each_rows_exposure() -> None:
    sensor = SensorConfig(mains_hz=100, flicker=0.2, readout_s=0.03, exposure_s=0.004)
    rows = sensor.row_flicker(0.123, 50)
    for row in (0, 17, 49):
        times = 0.123 + (row + 0.5) / 50 * 0.03 + (np.arange(4000) + 0.5) / 4000 * 0.004
        assert rows[row] == pytest.approx((1 + 0.2 * np.sin(2 * np.pi * 100 * times)).mean(), abs=1e-6)
    whole_periods = SensorConfig(mains_hz=100, flicker=0.2, exposure_s=0.01)
    assert np.allclose(whole_periods.row_flicker(0.5, 50), 1.0)


def test_drift_grows_from_nothing_to_the_configured_end() -> None:
    sensor = SensorConfig(exposure_drift=0.1, white_balance_drift=0.05)
    assert np.allclose(sensor.gains(0.0), 1.0)
    assert np.allclose(sensor.gains(1.0), [1.1 * 1.05, 1.1, 1.1 * 0.95])


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="exposure_s"):
        SensorConfig(exposure_s=0.0)
    with pytest.raises(ValueError, match="flicker"):
        SensorConfig(flicker=1.5)
