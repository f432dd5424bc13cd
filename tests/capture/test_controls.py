"""Two sets of settings are the same where both are known and no further apart than a read-back rounds."""

import pytest

from capture.controls import MATTERING, Controls, common_controls, controls_of_session
from capture.errors import CalibrationError
from capture.frame_record import FrameRecord
from capture.json_fields import Fields

SET = Controls(
    camera="C920",
    width=1920,
    height=1080,
    exposure_s=0.005,
    gain=64.0,
    white_balance_k=4600.0,
    focus=30.0,
    rate_hz=30.0,
)
EVERY = tuple(vars(SET))


def info(device=None, width=1920, height=1080):
    return {"device": device, "image": {"width": width, "height": height}}


def frame(index, **told):
    return FrameRecord(index=index, file=f"frames/{index}.png", width=1920, height=1080, **told)


def test_what_a_lock_read_back_is_what_the_session_was_set_to():
    controls = [
        {"name": "exposure_s", "requested": 0.005, "read_back": 0.00496},
        {"name": "gain", "requested": None, "read_back": 64},
        {"name": "white_balance_k", "requested": 4600.0, "read_back": None},
        {"name": "focus", "requested": None, "read_back": 30},
        {"name": "backlight_compensation", "requested": 0, "read_back": 0},
    ]
    found = controls_of_session(info({"camera": {"name": "C920"}, "controls": controls}), [])
    assert found == Controls(
        camera="C920",
        width=1920,
        height=1080,
        exposure_s=0.00496,
        gain=64.0,
        white_balance_k=4600.0,
        focus=30.0,
    )
    assert SET.differences(found, EVERY) == []  # 0.00496 s is within 2 % of 0.005 s


def test_a_phone_tells_its_settings_by_its_settings_file():
    settings = {"preference_white_balance": "manual", "preference_white_balance_temperature": "5000"}
    found = controls_of_session(info({"exposure_s": 0.008, "iso": 200, "settings": settings}), [])
    assert (found.exposure_s, found.gain, found.white_balance_k) == (0.008, 2.0, 5000.0)
    settings["preference_white_balance"] = "auto"
    assert controls_of_session(info({"settings": settings}), []).white_balance_k is None


def test_frames_tell_only_what_they_all_have():
    same = [frame(0, exposure_s=0.01, gain=2.0), frame(1, exposure_s=0.01, gain=4.0)]
    found = controls_of_session(info(), same)
    assert (found.exposure_s, found.gain) == (0.01, None)
    assert controls_of_session(info(), []) == Controls(width=1920, height=1080)


@pytest.mark.parametrize("name", EVERY)
def test_each_setting_that_differs_is_named(name):
    value = getattr(SET, name)
    other = "Brio" if name == "camera" else value + 120 if isinstance(value, int) else 1.5 * value
    differences = SET.differences(Controls(**(vars(SET) | {name: other})), EVERY)
    assert len(differences) == 1
    assert SET.differences(Controls(**(vars(SET) | {name: None})), EVERY) == []


def test_settings_that_several_share_are_common():
    found = common_controls([SET, Controls(width=1920, height=1080, gain=64.5, exposure_s=0.02)])
    assert found == Controls(width=1920, height=1080, gain=64.0)
    assert common_controls([]) == Controls()


def test_settings_survive_their_file_and_unknown_ones_are_refused():
    assert Controls.from_json(Fields(SET.to_json(), "here", CalibrationError)) == SET
    assert Controls().to_json() == {}
    for bad, said in (({"zoom": 2}, "zoom"), ({"gain": "high"}, "number"), ({"width": 0}, "whole number")):
        with pytest.raises(CalibrationError, match=said):
            Controls.from_json(Fields(bad, "here", CalibrationError))


def test_every_mattering_setting_is_one():
    assert {name for names in MATTERING.values() for name in names} <= set(EVERY)
