import numpy as np
import pytest

from capture.sim.lamp import LampConfig, PulseTrain


def test_the_lit_fraction_of_each_row_is_the_lamps_light_averaged_over_its_exposure() -> None:
    train = PulseTrain.schedule(LampConfig(first_s=0.11, rise_s=0.003, fall_s=0.002, droop=0.05), 3.0)
    for start_s in (0.05, 0.09, 0.13, 0.19, 0.21, 1.1):
        fraction = train.lit_fraction(start_s, 12, readout_s=0.03, exposure_s=0.008)
        for row in range(12):
            begin = start_s + (row + 0.5) / 12 * 0.03
            times = begin + (np.arange(20_000) + 0.5) / 20_000 * 0.008
            # Midpoint sums of a piecewise linear light: each of the few kinks costs at most (8 ms / 20000) /
            # 8 ms.
            assert fraction[row] == pytest.approx(train.level(times).mean(), abs=2e-4)


def test_a_frame_inside_a_pulse_is_lit_one_outside_is_not_and_one_across_its_edge_is_neither() -> None:
    train = PulseTrain.schedule(LampConfig(first_s=0.5, on_jitter_s=0.0, wander_s=0.0), 2.0)

    def flag(start_s: float) -> int | None:
        return train.flag(train.lit_fraction(start_s, 64, readout_s=0.02, exposure_s=0.005))

    assert flag(0.51) == 1
    assert flag(0.30) == 0
    assert flag(0.49) is None
    assert flag(0.59) is None
    assert flag(1.53) == 1


def test_a_timer_of_fixed_delay_only_ever_comes_late() -> None:
    config = LampConfig(period_s=1.0, wander_s=0.03, seed=4)
    starts = [pulse.on_s for pulse in PulseTrain.schedule(config, 60.0).pulses]
    gaps = np.diff(starts)
    assert gaps.min() >= 1.0
    assert gaps.max() <= 1.03
    assert np.std(gaps) > 0.005  # uniform over 30 ms has a deviation of 8.7 ms


def test_missed_pulses_leave_gaps_and_no_pulse_leaves_darkness() -> None:
    some = PulseTrain.schedule(LampConfig(missed=0.5, seed=1), 40.0)
    assert 8 <= len(some.pulses) <= 32  # 20 expected, 3.2 standard deviation
    none = PulseTrain.schedule(LampConfig(missed=1.0), 10.0)
    assert none.pulses == ()
    assert not none.lit_fraction(0.5, 8, 0.02, 0.01).any()


def test_a_lamp_that_always_burns_lights_every_row_of_every_frame() -> None:
    train = PulseTrain.schedule(LampConfig(always_on=True), 4.0)
    for start_s in (0.0, 1.3, 3.97):
        fraction = train.lit_fraction(start_s, 32, 0.02, 0.008)
        assert np.allclose(fraction, 1.0)
        assert train.flag(fraction) == 1


@pytest.mark.parametrize("wrong", [{"rise_s": 0.0}, {"on_s": 0.01}, {"period_s": 0.1}])
def test_a_lamp_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LampConfig(**wrong)
