"""The command line: help, usage, and one sentence with the right exit code for what can go wrong."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from capture.frame_record import FrameRecord
from capture.session import Session
from relight.cli import _COMMANDS, main

SENTENCES = {
    "no session": (["plan", "nowhere"], "nowhere is no session"),
    "nothing to import": (["fit", "nowhere"], "nowhere does not exist"),
    "no such preset": (["fit", "S", "--preset", "magic"], "known are solve, fast, balanced, paper"),
    "no setting of a preset": (["fit", "S", "--steps", "9"], "no setting 'steps'; it has none"),
    "a setting of another form": (["fit", "S", "--set", "crop"], "--set crop must be NAME=VALUE"),
    "no weights of VGG": (["fit", "S", "--vgg", "no.pth"], "no.pth does not exist; name what --vgg"),
    "no name for a folder": (["fit", "S", "--name", "../x"], "cannot be called"),
    "not to be forced": (["plan", "S", "--force", "poses=run"], "NAME one of undistortion"),
    "weights that are not there": (
        ["fit", "S", "--u2net", "no.pth"],
        "no.pth does not exist; name what --u2net",
    ),
    "nothing to fit": (["fit", "S"], "no frame is fully lit"),
    "a plan that refuses": (["plan", "S"], "no frame is fully lit"),
    "no portrait": (["report", "S"], "no portrait yet; make one with `relight fit S`"),
    "no portrait to render": (["render", "S", "--light", "room", "--out", "pictures"], "no portrait yet"),
    "no light": (["render", "S", "--out", "pictures"], "name a --light"),
    "an unknown light": (["render", "S", "--light", "moon", "--out", "pictures"], 'no light "moon"'),
    "maps as a video": (["render", "S", "--light", "room", "--maps", "--out", "x.mp4"], "takes one --light"),
    "no portrait to measure": (["evaluate", "S", "--truth", "."], "no portrait yet"),
    "no source": (["import", "nothing.mp4", "--out", "T"], "nothing.mp4 does not exist"),
    "a folder that is not a demo's": (["demo", "--out", "S"], "was not made by a demo"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with an unlit session S in it."""
    monkeypatch.chdir(tmp_path)
    with Session.create(tmp_path / "S", source={"kind": "test"}, width=8, height=6) as session:
        file = session.write_frame(0, np.zeros((6, 8, 3), np.uint8))
        session.append_frame(FrameRecord(index=0, file=file, width=8, height=6, flash=0))
    return tmp_path


@pytest.mark.parametrize("name", _COMMANDS)
def test_help_has_an_example(capsys, name):
    assert main([name, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"example:\n  relight {name} " in said
    assert "--debug" in said


def test_help_lists_every_command_and_no_other(capsys):
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    for name in _COMMANDS:
        assert f"\n    {name} " in said
    for to_come in ("view", "export", "batch"):
        assert f"\n    {to_come} " not in said


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["view", "S"],
        ["fit"],
        ["import", "x.mp4"],
        ["import", "x.mp4", "--out", "S", "--rate", "0"],
        ["fit", "S", "--max-seconds", "0"],
        ["fit", "S", "--unknown"],
        ["render", "S", "--out", "x", "--orbit", "--cameras", "c.json"],
    ],
    ids=" ".join,
)
def test_a_command_line_that_is_not_understood_is_two(capsys, argv):
    assert main(argv) == 2
    assert "usage: relight" in capsys.readouterr().err


@pytest.mark.parametrize(("argv", "sentence"), SENTENCES.values(), ids=SENTENCES.keys())
def test_what_cannot_be_done_is_one_sentence_and_one(capsys, folder, argv, sentence):
    assert main(argv) == 1
    said = capsys.readouterr().err
    assert sentence in said
    assert said.startswith("relight: ")
    assert said.count("\n") == 1
    assert "Traceback" not in said


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA card")
def test_a_card_that_is_not_there_is_said(capsys, folder):
    assert main(["fit", "S", "--device", "cuda"]) == 1
    assert "--device cpu" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["before", "after"])
def test_debug_shows_where(capsys, folder, place):
    argv = ["--debug", "report", "S"] if place == "before" else ["report", "S", "--debug"]
    assert main(argv) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "no portrait yet" in said


def test_help_loads_nothing_heavy():
    program = (
        "import sys; from relight.cli import main\n"
        "for argv in [['--help'], *([name, '--help'] for name in sys.argv[1:])]: main(argv)\n"
        "heavy = ('torch', 'numpy', 'cv2', 'av', 'scipy', 'rich')\n"
        "print('LOADED', [name for name in heavy if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, *_COMMANDS], capture_output=True, text=True, check=True
    )
    assert result.stdout.endswith("LOADED []\n")


def test_the_version_is_one_line(capsys):
    assert main(["--version"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_ctrl_c_is_one_line_and_130(capsys, folder, monkeypatch):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "open", interrupted)
    assert main(["plan", "S"]) == 130
    assert capsys.readouterr().err.count("\n") == 1
