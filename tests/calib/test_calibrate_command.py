"""The command from a printed board to a calibration.json that other tools can read, and what it refuses."""

import json
import re

import cv2
import numpy as np
import pytest

from calib.board.charuco import load_board, save_board
from calib.calibration import load_calibration
from calib.lens.save import evidence_path
from capture.images import write_png
from capture.video import VideoWriter
from relight.cli import main


@pytest.fixture(scope="module")
def stills(tmp_path_factory, pictures):
    """A folder with pictures of the board."""
    folder = tmp_path_factory.mktemp("stills")
    for number, (picture, _) in enumerate(pictures):
        write_png(folder / f"{number:02d}.png", picture)
    return folder


def check_lens(path, lens):
    """The truth is within 4.5 standard deviations of each of eight numbers, and these say something."""
    intrinsics = load_calibration(path).intrinsics
    assert (intrinsics.width, intrinsics.height) == (480, 360)
    for found, truth in ((intrinsics.pinhole, lens[:4]), (intrinsics.distortion, lens[4:])):
        sigma = np.maximum(found.sigma, 1e-9)
        assert (
            np.abs(found.value - truth[: len(sigma)])[found.sigma > 0] < 4.5 * sigma[found.sigma > 0]
        ).all()
    assert (intrinsics.pinhole.sigma < 1.0).all()
    return intrinsics


def test_stills_become_a_calibration_a_report_and_files_for_other_tools(
    tmp_path, capsys, stills, board, lens, read_page
):
    save_board(board, tmp_path / "board.json")
    out, page = tmp_path / "calibration.json", tmp_path / "lens.html"
    arguments = ["calibrate", "intrinsics", str(stills), "--board", str(tmp_path / "board.json")]
    assert main([*arguments, "--out", str(out), "--report", str(page)]) == 0
    said = capsys.readouterr().out
    assert "14 pictures searched, 14 views used" in said
    assert re.search(r"fx 4\d\d\.\d+ ± 0\.\d+", said)
    intrinsics = check_lens(out, lens)
    assert "ChArUco 5 x 7 squares of 30 mm" in intrinsics.pinhole.source

    evidence = json.loads(evidence_path(out).read_text())
    assert np.array(evidence["covariance"]).shape == (11, 11)
    assert evidence["values"][:4] == intrinsics.pinhole.value.tolist()
    assert len(evidence["views"]) == 14
    assert evidence["projection"]["columns"] * evidence["projection"]["rows"] == len(
        evidence["projection"]["sigma_px"]
    )

    html = page.read_text()
    assert html.count("<svg") == html.count("</svg>") >= 7
    for outside in ("http:", "https:", "<script", "src="):
        assert outside not in html
    assert "nan" not in re.sub(r"<[^>]*>", "", html)
    assert not re.search(r'="[^"]*nan', html)

    whole = read_page(out)
    assert "Lens</td><td>" in whole
    assert "projection uncertainty" in whole

    for name in ("lens.yml", "cameras.txt", "camchain.yaml", "lens.cameramodel"):
        assert main(["calibrate", "convert", str(out), "--out", str(tmp_path / name)]) == 0
        again = tmp_path / f"{name}.json"
        assert main(["calibrate", "convert", str(tmp_path / name), "--out", str(again)]) == 0
        back = load_calibration(again).intrinsics
        assert np.allclose(back.pinhole.value, intrinsics.pinhole.value, atol=1e-12, rtol=0)
        assert np.array_equal(
            np.trim_zeros(back.distortion.value, "b"), np.trim_zeros(intrinsics.distortion.value, "b")
        )


def test_a_film_is_calibrated_as_stills_are(tmp_path, pictures, lens):
    film = tmp_path / "film.mp4"
    with VideoWriter(film, 480, 360, crf=8) as writer:
        for number, (picture, _) in enumerate(pictures):
            for repeat in range(2):  # held still for two frames, a quarter of a second apart
                at_s = number * 0.25 + repeat * 0.04
                writer.write(np.repeat(picture[..., None], 3, axis=2), at_s)
    out = tmp_path / "calibration.json"
    flags = ["--squares", "5x7", "--square-mm", "30", "--marker-mm", "22"]
    assert main(["calibrate", "intrinsics", str(film), *flags, "--model", "k1k2p1p2", "--out", str(out)]) == 0
    check_lens(out, lens)


def test_a_printed_board_is_described_beside_it(tmp_path, capsys):
    out = tmp_path / "board.png"
    assert (
        main(["calibrate", "board", "--out", str(out), "--square-mm", "20", "--legacy", "--dpi", "60"]) == 0
    )
    board = load_board(tmp_path / "board.json")
    assert (board.square_m, board.marker_m, board.layout) == (0.02, 0.0144, "legacy")
    assert cv2.imread(str(out)).shape[:2] == (702, 496)
    assert str(tmp_path / "board.json") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["board", "--out", "b.pdf", "--squares", "9x12"], "does not fit on a4"),
        (["board", "--out", "b.doc"], ".pdf or a .png"),
        (["intrinsics", "nowhere", "--out", "c.json"], "nowhere does not exist"),
        (["intrinsics", "{stills}", "--board", "none.json", "--out", "c.json"], "none.json cannot be read"),
        (["intrinsics", "{stills}", "--out", "c.json"], "not arranged as on this board"),
        (["intrinsics", "{stills}", "--board", "b", "--legacy", "--out", "c.json"], "not both"),
        (["convert", "none.yaml", "--out", "c.json"], "none.yaml cannot be read"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(tmp_path, monkeypatch, capsys, stills, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", *(word.replace("{stills}", str(stills)) for word in arguments)]) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert words in said[-1]
    assert "Traceback" not in "".join(said)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate"],
        ["calibrate", "board"],
        ["calibrate", "board", "--out", "b.pdf", "--squares", "7"],
        ["calibrate", "intrinsics", "x", "--out", "c.json", "--model", "k9"],
    ],
)
def test_a_wrong_command_line_is_a_usage_error(arguments):
    assert main(arguments) == 2


def test_each_part_has_help(capsys):
    for part in ("board", "intrinsics", "flash", "response", "dark", "flat", "readout", "convert"):
        assert main(["calibrate", part, "--help"]) == 0
        assert "--debug" in capsys.readouterr().out
