from collections import namedtuple
from types import SimpleNamespace

import pytest

from capture.controller.config import CaptureConfig
from capture.controller.stop_rules import StopRules
from capture.devices.camera import ControlReport
from capture.tagging.watch import PulseStatus

Usage = namedtuple("Usage", "free")


@pytest.fixture
def rules(tmp_path):
    return StopRules(CaptureConfig(), tmp_path, fps=30.0)


def test_good_light_stops_nothing(rules):
    assert all(rules.of_light(0.2, 0.03) is None for _ in range(200))


def test_a_second_of_white_frames_stops_but_flashes_do_not(rules):
    lit_every = [rules.of_light(0.9, 0.9 if k % 30 < 3 else 0.1) for k in range(120)]
    assert set(lit_every) == {None}
    sentence = [rules.of_light(1.0, 0.8) for _ in range(40)][-1]
    assert "80% of the picture is clipped" in sentence
    assert "--exposure" in sentence


def test_black_frames_stop_unless_a_flash_is_among_them(rules):
    assert all(rules.of_light(0.3 if k % 30 == 0 else 0.0, 0.0) is None for k in range(120))
    assert "lens cap" in [rules.of_light(1e-5, 0.0) for _ in range(70)][-1]


def status(seen=0, expected=0, unseen=0):
    return PulseStatus(seen, expected, unseen, None, 0.0)


def test_four_reported_flashes_in_a_row_that_are_not_seen_stop(rules):
    assert rules.of_pulses(status(expected=3, unseen=3), 5.0) is None
    assert "The last 4 flashes are not seen" in rules.of_pulses(status(expected=4, unseen=4), 5.0)
    assert "not seen" in rules.of_pulses(status(seen=9, expected=13, unseen=4), 14.0)
    assert rules.of_pulses(status(seen=12, expected=13), 14.0) is None


def test_a_flash_that_reports_nothing_is_waited_for_longer(rules):
    assert rules.of_pulses(status(), 10.9) is None
    assert "for 11 s" in rules.of_pulses(status(), 11.1)
    assert rules.of_pulses(status(seen=1), 60.0) is None


def test_controls_that_drifted_stop_when_they_are_seen_twice(rules):
    camera = SimpleNamespace(check=lambda: (ControlReport(name="gain", requested=1.0, read_back=4.0),))
    assert rules.of_devices(camera, 0.0) is None
    assert rules.of_devices(camera, 0.5) is None  # looked at once a second
    assert "gain went from 1 to 4" in rules.of_devices(camera, 1.1)


def test_a_stale_read_back_is_forgiven(rules):
    drifted = (ControlReport(name="gain", requested=1.0, read_back=4.0),)
    answers = iter([drifted, (), drifted, ()])
    camera = SimpleNamespace(check=lambda: next(answers))
    assert [rules.of_devices(camera, float(2 * k)) for k in range(4)] == [None] * 4


def test_a_disk_that_fills_stops_before_it_is_full(rules, monkeypatch):
    camera = SimpleNamespace(check=lambda: ())
    monkeypatch.setattr("shutil.disk_usage", lambda path: Usage(free=10_000_000))
    assert "10 MB left, less than the 315 MB" in rules.of_devices(camera, 0.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"period_s": 0.2},
        {"on_s": 0.3},
        {"on_s": 0.0},
        {"period_s": 0.4, "on_s": 0.21},
        {"duration_s": 2.0},
        {"duration_s": float("inf")},
        {"level": 0.0},
        {"kept_rate_hz": float("nan")},
    ],
)
def test_settings_beyond_safety_or_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(reversed(wrong))):
        CaptureConfig(**wrong)


@pytest.mark.parametrize("fps", [7.5, 15.0, 24.0, 25.0, 29.7, 29.97, 30.0, 50.0, 60.0])
def test_flashes_begin_ever_elsewhere_in_their_frames(fps):
    period_s = CaptureConfig().train_period_s(fps)
    assert 1.0 <= period_s < 1.0 + 1 / fps
    assert (period_s * fps) % 1 == pytest.approx(0.382, abs=1e-6)
    assert CaptureConfig(phase_step=0.0).train_period_s(fps) == 1.0
