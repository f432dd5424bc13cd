"""Boards by their USB ids, as pyserial lists them, none of them opened."""

from types import SimpleNamespace

import pytest

from capture.devices.serial_flash import list_flashes
from capture.devices.serial_flash.boards import find_boards
from capture.devices.serial_flash.port import _why_not


def port(device, vid=None, pid=None, serial_number=None, product=None):
    return SimpleNamespace(device=device, vid=vid, pid=pid, serial_number=serial_number, product=product)


def test_boards_that_may_be_the_flash_are_found_and_others_are_not():
    ports = [
        port("/dev/ttyUSB1", 0x1A86, 0x7523, product="USB Serial"),
        port("/dev/ttyACM0", 0x2341, 0x0043, "85733323930351B0A1C2", "Arduino Uno"),
        port("/dev/ttyACM1", 0x2E8A, 0x000A, "E6605838", "Pico"),
        port("/dev/ttyACM2", 0x2341, 0x8036),
        port("/dev/ttyS0"),
        port("/dev/ttyACM9", 0x1234, 0x5678, product="A modem"),
    ]
    boards = find_boards(ports)
    assert [board.url for board in boards] == ["/dev/ttyACM0", "/dev/ttyACM1", "/dev/ttyACM2", "/dev/ttyUSB1"]
    assert [board.name for board in boards] == [
        "Arduino Uno R3",
        "Raspberry Pi Pico",
        "Arduino",
        "CH340 (Arduino Nano, many others): USB Serial",
    ]
    assert boards[0].serial_number == "85733323930351B0A1C2"
    assert boards[3].serial_number == ""


def test_the_machines_own_ports_are_listed_as_urls():
    assert all(isinstance(url, str) for url in list_flashes())


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "could not open port"), "group dialout"),
        (OSError("could not open port 'COM3': PermissionError(13, 'Access is denied.', None, 5)"), "dialout"),
        (OSError(16, "Device or resource busy"), "in use by another program"),
        (OSError(19, "No such device"), "does not exist"),
    ],
)
def test_why_a_port_cannot_be_opened_says_what_to_do(error, said):
    assert said in _why_not("/dev/ttyUSB0", error)
