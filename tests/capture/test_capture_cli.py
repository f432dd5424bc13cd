"""`relight-capture` as a person types it."""

import json
import re
import urllib.request

import pytest

from capture.cli import main
from capture.session import Session


@pytest.fixture
def typed(one_rig, tmp_path, capsys):
    """Runs the command in simulated time; (exit code, stdout, stderr)."""

    def run(*arguments):
        code = main([*arguments, "--out", str(tmp_path / "S")])
        seen = capsys.readouterr()
        return code, seen.out, seen.err

    return run


def test_a_capture_says_what_it_kept(typed, tmp_path):
    code, out, _ = typed("--flash", "sim:", "--camera", "sim:coarse", "--duration", "4", "--quiet")
    assert code == 0
    assert re.search(r"S: 12[01] frames, \d+ lit and \d+ unlit ones kept", out)
    assert re.search(r"0 frames lost, [34] flashes seen, [+-]\d\.\d ms after they were reported", out)
    assert "0 frames contradict the flash" in out
    session = Session.open(tmp_path / "S")
    assert session.status == "complete"
    assert session.info["flash_schedule"]["on_s"] == 0.1


def test_it_shows_itself_in_lines_and_on_a_page_of_this_machine(one_rig, tmp_path, capsys, monkeypatch):
    from capture.controller import showing

    seen = []
    update = showing.PreviewServer.update

    def look(server, state, picture):
        update(server, state, picture)
        if len(seen) < 2:
            with urllib.request.urlopen(server.url + "state.json", timeout=5) as answer:
                seen.append(json.loads(answer.read()))

    monkeypatch.setattr(showing.PreviewServer, "update", look)
    camera = ["--camera", "sim:coarse", "--flash", "sim:", "--duration", "4", "--exposure", "0.05"]
    assert main([*camera, "--preview", "--out", str(tmp_path / "S")]) == 0
    err = capsys.readouterr().err
    assert "the preview is at http://127.0.0.1:" in err
    assert err.count("clamped to 0.03") == 1
    assert "pulses" in err
    assert seen[0]["frames"] >= 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "name the flash"),
        (["--flash", "sim:", "--period", "0.2"], "three flashes a second"),
        (["--flash", "sim:", "--on", "0.4"], "on_s is 0.4"),
        (["--flash", "sim:", "--size", "wide"], "such as 1280x720"),
        (["--flash", "sim:", "--duration", "1"], "three flashes, 3 s, are the least"),
        (["--flash", "sim:", "--duration", "1e9"], "65535 flashes, 65535 s, are the most"),
        (["--flash", "sim:", "--gain", "nan"], "gain is nan"),
        (["--flash", "sim:", "--focus", "inf"], "focus is inf"),
    ],
)
def test_a_command_that_cannot_be_is_refused_with_code_two(typed, arguments, says, tmp_path):
    code, _, err = typed(*arguments)
    assert code == 2
    assert says in err
    assert not (tmp_path / "S").exists()


@pytest.mark.parametrize(
    ("flash", "camera", "says"),
    [
        ("nonsense:", "sim:coarse", "names no flash"),
        ("sim:", "nonsense:", "names no camera"),
        ("sim:", "", "names no camera"),
        ("/dev/ttyNONE", "sim:coarse", "/dev/ttyNONE"),
        ("sim:", "/dev/video99", "/dev/video99"),
        ("sim:", "sim:fast", "known are seed="),
        ("sim:bright", "sim:coarse", "known are missed="),
        ("sim:unplug_s=3", "sim:coarse", "unplugged"),
    ],
)
def test_what_goes_wrong_is_one_sentence_and_code_one(typed, flash, camera, says):
    code, _, err = typed("--flash", flash, "--camera", camera, "--duration", "6", "--quiet")
    assert code == 1
    assert says in err.strip().splitlines()[-1]
    assert "Traceback" not in err


def test_a_capture_in_which_no_flash_is_found_is_no_success(typed, tmp_path):
    """Too short for the rule that stops it: nothing is said until the tags are made."""
    camera = "fake-v4l2:width=160;height=120"
    code, _, err = typed("--flash", "sim:missed=1", "--camera", camera, "--duration", "3", "--quiet")
    assert code == 1
    assert err.count("lit and unlit") == 1
    assert Session.open(tmp_path / "S").status == "interrupted"


def test_a_lamp_that_cannot_dim_is_told_before_a_folder_is_made(typed, tmp_path):
    code, _, err = typed("--flash", "manual:", "--camera", "sim:coarse", "--level", "0.5", "--quiet")
    assert code == 1
    assert "cannot dim its light to 0.5" in err
    assert not (tmp_path / "S").exists()


def test_resuming_needs_a_session_to_go_on_with(typed, tmp_path):
    code, _, err = typed("--flash", "sim:", "--camera", "sim:coarse", "--resume", "--quiet")
    assert code == 1
    assert "is no session" in err


def test_what_is_plugged_in_is_listed_without_a_flash_or_folder(capsys, monkeypatch):
    monkeypatch.setattr("capture.devices.table.list_cameras", lambda: ("/dev/video0",))
    monkeypatch.setattr("capture.devices.table.list_flashes", lambda: ())
    assert main(["--list"]) == 0
    assert capsys.readouterr().out.splitlines() == ["camera: /dev/video0", "flash: none found"]
