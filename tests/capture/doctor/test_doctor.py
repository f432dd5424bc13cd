"""The doctor finds what is wrong, says what to do, and is content with what is well."""

import importlib.metadata
import json
from collections import namedtuple
from dataclasses import replace

import pytest

from capture.devices.camera import CameraProfile
from capture.doctor import permissions, rehearsal
from capture.doctor.devices import look_at_devices
from capture.doctor.disk import look_at_disk
from capture.doctor.finding import Finding, Level
from capture.doctor.machine import look_at_machine
from capture.doctor.permissions import look_at_permissions, udev_rules
from capture.doctor.quirks import known_quirks
from capture.doctor.rehearsal import rehearse
from capture.errors import CameraError, SessionError
from relight.cli import main

Usage = namedtuple("Usage", "free")


def of(findings, topic, level=None):
    return [f for f in findings if f.topic == topic and (level is None or f.level == level)]


def test_a_library_that_is_missing_or_displaced_is_named_with_its_remedy(monkeypatch):
    known = importlib.metadata.version

    def version(name):
        if name == "rawpy":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0" if name == "hid" else known(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    bad = of(look_at_machine(), "library", Level.BAD)
    assert any("rawpy is missing" in f.sentence and f.remedy == "pip install rawpy" for f in bad)
    assert any("hid is installed and has the same module name" in f.sentence for f in bad)
    assert any("reinstall --no-deps hidapi" in f.remedy for f in bad)


def test_a_device_file_that_is_closed_to_us_comes_with_group_and_rule(monkeypatch, tmp_path):
    node = tmp_path / "ttyUSB0"
    node.touch()
    monkeypatch.setattr(permissions.sys, "platform", "linux")
    monkeypatch.setattr(permissions.glob, "glob", lambda p: [str(node)] if "ttyUSB" in p else [])
    monkeypatch.setattr(permissions.os, "access", lambda path, mode: False)
    (finding,) = look_at_permissions()
    assert finding.level == Level.BAD
    assert str(node) in finding.sentence
    assert "usermod -aG dialout" in finding.remedy
    assert "relight doctor --udev" in finding.remedy
    monkeypatch.setattr(permissions.os, "access", lambda path, mode: True)
    assert [f.level for f in look_at_permissions()] == [Level.GOOD]


def test_the_udev_rules_name_every_lamp_and_every_line_is_a_rule_or_a_remark():
    rules = udev_rules()
    for vendor, product in (("046d", "c900"), ("046d", "c903"), ("16c0", "05df"), ("27b8", "01ed")):
        assert f'ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}"' in rules
    for line in rules.splitlines():
        assert line.startswith("#") or (line.startswith('SUBSYSTEM=="') and 'TAG+="uaccess"' in line)


def test_a_full_or_slow_disk_is_bad(tmp_path, monkeypatch):
    monkeypatch.setattr("capture.doctor.disk._frames_hz", lambda folder: 90.0)
    assert {f.level for f in look_at_disk(tmp_path)} == {Level.GOOD}
    monkeypatch.setattr("capture.doctor.disk.shutil.disk_usage", lambda path: Usage(free=10**8))
    monkeypatch.setattr("capture.doctor.disk._frames_hz", lambda folder: 9.0)
    space, speed = look_at_disk(tmp_path)
    assert (space.level, speed.level) == (Level.BAD, Level.BAD)
    assert "0.1 GB free" in space.sentence
    assert "9 frames" in speed.sentence


def test_the_trial_of_the_disk_leaves_nothing_and_a_missing_folder_is_told(tmp_path):
    look_at_disk(tmp_path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SessionError, match="none"):
        look_at_disk(tmp_path / "none")


def test_cameras_that_are_known_for_something_are_recognised():
    assert "forgets manual exposure" in known_quirks("046D", "082d", "uvcvideo")[0]
    assert "clamps" in known_quirks("046D", "082d", "uvcvideo")[1]
    assert known_quirks("", "", "") == []


def test_what_cannot_be_opened_is_a_finding_and_no_end(monkeypatch):
    def refuse(url):
        raise CameraError("/dev/video7 is in use; close what uses it.")

    monkeypatch.setattr("capture.doctor.devices.list_cameras", lambda: ("/dev/video7",))
    monkeypatch.setattr("capture.doctor.devices.list_flashes", lambda: ("/dev/ttyUSB3",))
    monkeypatch.setattr("capture.doctor.devices.open_camera", refuse)
    findings = look_at_devices()
    assert of(findings, "camera", Level.BAD)[0].sentence.startswith("/dev/video7 is in use")
    assert "/dev/ttyUSB3 may be a flash" in of(findings, "flash")[0].sentence


def test_a_good_pair_rehearses_well(one_rig):
    findings = rehearse("sim:coarse;fps=29.7", "sim:", CameraProfile(), 0.1)
    assert not [f for f in findings if f.level == Level.BAD]
    assert of(findings, "lock", Level.GOOD)
    assert "8 flashes were seen" in of(findings, "flash")[0].sentence
    assert any("lights a frame in full" in f.sentence for f in findings)


def test_a_flash_shorter_than_the_shutter_needs_is_bad(one_rig):
    findings = rehearse("sim:coarse;fps=29.7", "sim:", CameraProfile(exposure_s=0.02), 0.04)
    bad = of(findings, "flash", Level.BAD)
    assert bad
    assert any("Lengthen the flash" in f.remedy or "No flash" in f.sentence for f in bad)


def test_an_exposure_that_the_light_does_not_follow_is_found():
    """The driver says yes to every exposure and leaves the sensor as it is."""
    findings = rehearse(
        "fake-v4l2:profile=ignores-exposure;width=320;height=240",
        "sim:",
        CameraProfile(exposure_s=0.008),
        0.1,
    )
    bad = of(findings, "lock", Level.BAD)
    assert [f for f in bad if "exposure_s" in f.sentence and "the light does not follow" in f.sentence]


def test_a_lamp_that_is_dead_is_told(one_rig):
    findings = rehearse("sim:coarse", "sim:missed=1", CameraProfile(), 0.1)
    assert of(findings, "rehearsal", Level.BAD)[0].sentence.startswith("The last 4 flashes are not seen")


def test_the_command_ends_with_an_error_exactly_when_something_is_bad(capsys, tmp_path, monkeypatch):
    good = [Finding("disk", Level.GOOD, "much room"), Finding("camera", Level.NOTE, "a remark")]
    monkeypatch.setattr("relight.commands.doctor._look", lambda args: good)
    assert main(["doctor", "--json", str(tmp_path / "d.json")]) == 0
    assert [f["level"] for f in json.loads((tmp_path / "d.json").read_text())] == ["good", "note"]
    monkeypatch.setattr(
        "relight.commands.doctor._look",
        lambda args: [*good, Finding("disk", Level.BAD, "no room", "make some")],
    )
    assert main(["doctor"]) == 1
    seen = capsys.readouterr()
    assert "make some" in seen.out
    assert "1 of 3 findings are bad; the first: no room" in seen.err
    assert main(["doctor", "--udev"]) == 0
    assert "27b8" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--on", "5"], "on_s is 5.0; it must be positive, at most 0.25 s"),
        (["--on", "nan"], "on_s is nan"),
        (["--exposure", "-1"], "exposure_s is -1.0"),
    ],
)
def test_numbers_that_cannot_be_are_told(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("capture.doctor.disk._frames_hz", lambda folder: 100.0)
    devices = ["--camera", "sim:coarse", "--flash", "sim:"]
    assert main(["doctor", *devices, *arguments, "--out", str(tmp_path)]) == 1
    assert says in capsys.readouterr().err


def test_a_report_that_cannot_be_written_is_named_as_it_was_typed(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("capture.doctor.disk._frames_hz", lambda folder: 100.0)
    missing = tmp_path / "missing" / "found.json"
    assert main(["doctor", "--out", str(tmp_path), "--json", str(missing)]) == 1
    assert f"{missing} cannot be written" in capsys.readouterr().err


def test_ctrl_c_in_a_rehearsal_ends_it(monkeypatch):
    run = rehearsal.run_capture

    def interrupted(*args):
        return replace(run(*args), signal="SIGINT")

    monkeypatch.setattr(rehearsal, "run_capture", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rehearse("fake-v4l2:width=160;height=120", "sim:", CameraProfile(), 0.1)
