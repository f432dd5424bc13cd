"""The table of controls against the specification's: the wrong entity sets the gain for the exposure."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.devices.uvc.control_table import CONTROLS
from capture.devices.uvc.descriptors import Entity

CT, PU = Entity.CAMERA_TERMINAL, Entity.PROCESSING_UNIT
#: UVC 1.5: name -> entity, selector (A-12, A-13), bit of bmControls (3-6, 3-8), wLength and sign (4.2.2).
SPECIFIED = {
    "auto_exposure_mode": (CT, 0x02, 1, 1, False),
    "auto_exposure_priority": (CT, 0x03, 2, 1, False),
    "exposure_time_absolute": (CT, 0x04, 3, 4, False),
    "focus_absolute": (CT, 0x06, 5, 2, False),
    "focus_auto": (CT, 0x08, 17, 1, False),
    "iris_absolute": (CT, 0x09, 7, 2, False),
    "zoom_absolute": (CT, 0x0B, 9, 2, False),
    "pan_absolute": (CT, 0x0D, 11, 8, True),
    "tilt_absolute": (CT, 0x0D, 11, 8, True),
    "roll_absolute": (CT, 0x0F, 13, 2, True),
    "privacy": (CT, 0x11, 18, 1, False),
    "backlight_compensation": (PU, 0x01, 8, 2, False),
    "brightness": (PU, 0x02, 0, 2, True),
    "contrast": (PU, 0x03, 1, 2, False),
    "gain": (PU, 0x04, 9, 2, False),
    "power_line_frequency": (PU, 0x05, 10, 1, False),
    "hue": (PU, 0x06, 2, 2, True),
    "saturation": (PU, 0x07, 3, 2, False),
    "sharpness": (PU, 0x08, 4, 2, False),
    "gamma": (PU, 0x09, 5, 2, False),
    "white_balance_temperature": (PU, 0x0A, 6, 2, False),
    "white_balance_temperature_auto": (PU, 0x0B, 12, 1, False),
    "white_balance_blue": (PU, 0x0C, 7, 4, False),
    "white_balance_red": (PU, 0x0C, 7, 4, False),
    "white_balance_component_auto": (PU, 0x0D, 13, 1, False),
    "digital_multiplier": (PU, 0x0E, 14, 2, False),
    "digital_multiplier_limit": (PU, 0x0F, 15, 2, False),
    "hue_auto": (PU, 0x10, 11, 1, False),
    "contrast_auto": (PU, 0x13, 18, 1, False),
}


def test_every_control_is_where_the_specification_has_it() -> None:
    found = {
        name: (control.entity, control.selector, control.bit, control.length, control.signed)
        for name, control in CONTROLS.items()
    }
    assert found == SPECIFIED


def test_selector_four_is_exposure_in_one_entity_and_gain_in_the_other() -> None:
    fours = {control.entity: name for name, control in CONTROLS.items() if control.selector == 4}
    assert fours == {CT: "exposure_time_absolute", PU: "gain"}


@pytest.mark.parametrize("name", sorted(CONTROLS))
@settings(max_examples=20)
@given(data=st.data())
def test_numbers_come_back_and_leave_their_neighbours_alone(name: str, data: st.DataObject) -> None:
    control = CONTROLS[name]
    value = data.draw(st.integers(*control.span))
    around = data.draw(st.binary(min_size=control.length, max_size=control.length))
    encoded = control.encode(value, around)
    assert len(encoded) == control.length
    assert control.decode(encoded) == value
    inside = range(control.offset, control.offset + control.size)
    assert all(encoded[i] == around[i] for i in range(control.length) if i not in inside)


def test_numbers_are_little_endian_and_signs_are_twos_complement() -> None:
    assert CONTROLS["exposure_time_absolute"].encode(50, bytes(4)) == b"\x32\x00\x00\x00"
    assert CONTROLS["brightness"].encode(-5, bytes(2)) == b"\xfb\xff"
