"""The page of a calibration: what is known, how well, from what, and what is assumed."""

import json

import numpy as np
import pytest

from calib.calibration import Calibration, Quantity, load_calibration, save_calibration
from calib.colour.chart import ChartReading
from calib.colour.fit import fit_colour
from calib.colour.reference import load_reference
from calib.colour.save import colour_evidence_path, save_colour
from calib.errors import ReportError
from calib.report.part import DOUBTFUL, GOOD, UNKNOWN
from calib.report.write import write_calibration_report
from capture.controls import Controls
from capture.errors import CalibrationError
from capture.response import Response
from relight.cli import main

CAMERA = np.array([[0.70, 0.24, 0.06], [0.20, 0.68, 0.12], [0.05, 0.25, 0.70]])


def colours(noise):
    patches = 0.6 * load_reference("after 2014").srgb @ CAMERA.T
    patches = patches + np.random.default_rng(0).normal(0, noise, patches.shape)
    return fit_colour([ChartReading("chart.png", patches, np.full((24, 3), noise))], "after 2014")


def sensor():
    return Calibration(
        response=Response("srgb", source="as named"),
        dark=Quantity.of([0.01] * 3, "1", "8 dark <pictures>", [1e-4] * 3, Controls(gain=4.0)),
        noise_read=Quantity.of([1e-3] * 3, "1", "pairs", [1e-5] * 3),
        noise_shot=Quantity.of([2e-4] * 3, "1", "pairs", [1e-5] * 3),
        flat_field=Quantity.of([-0.3, 0.02], "1", "wall", [0.01, 0.01]),
    )


def verdicts(path):
    return {part.name: part for part in write_calibration_report(path, path.with_suffix(".html"))}


def test_all_that_is_known_is_on_the_page(tmp_path, read_page):
    path = tmp_path / "calibration.json"
    save_calibration(sensor(), path)
    save_colour(colours(0.001), colours(0.001), path, "chart.png", Controls(white_balance_k=5000.0))
    page = read_page(path)
    found = verdicts(path)
    assert {name for name, part in found.items() if part.verdict == GOOD} == {
        "Response",
        "Dark level",
        "Noise",
        "Flat field",
        "Colour",
    }
    assert found["Lens"].verdict == found["Flash"].verdict == UNKNOWN
    assert "8 dark &lt;pictures&gt;" in page
    assert "gain 4.0" in page
    assert "white_balance_k 5000.0" in page
    assert "taken to be at the lens" in page
    assert page.count("dark skin") >= 2  # its swatch and its bar


def test_colours_that_are_off_are_doubted(tmp_path):
    path = tmp_path / "calibration.json"
    save_colour(colours(0.008), None, path, "chart.png")
    found = verdicts(path)["Colour"]
    assert found.verdict == DOUBTFUL
    assert found.warnings


def test_evidence_of_another_calibration_is_not_shown(tmp_path):
    path = tmp_path / "calibration.json"
    save_colour(colours(0.001), None, path, "chart.png")
    changed = Quantity.of(1.1 * load_calibration(path).colour.value, "1", "by hand")
    save_calibration(Calibration(colour=changed), path)
    found = verdicts(path)["Colour"]
    assert found.verdict == DOUBTFUL
    assert "does not lie beside" in found.why
    assert "<svg" not in found.body


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ({"schema": "relight-session"}, "schema"),
        ({"version": 99}, "newer"),
        ({"flash": {"matrix": [[1]]}}, "shape"),
    ],
)
def test_damaged_evidence_is_refused(tmp_path, damage, said):
    path = tmp_path / "calibration.json"
    save_colour(colours(0.001), None, path, "chart.png")
    beside = colour_evidence_path(path)
    beside.write_text(json.dumps(json.loads(beside.read_text()) | damage))
    with pytest.raises(CalibrationError, match=said):
        write_calibration_report(path, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_calibration_in_which_nothing_is_known_has_a_page_that_says_so(tmp_path, read_page):
    path = tmp_path / "calibration.json"
    save_calibration(Calibration(), path)
    page = read_page(path)
    assert page.count("not known") == 7
    assert "No flat field is known" in page


def test_no_calibration_is_one_sentence(tmp_path, capsys):
    with pytest.raises(ReportError, match="relight calibrate"):
        write_calibration_report(tmp_path / "none.json", tmp_path / "page.html")
    assert main(["calibrate", "report", str(tmp_path)]) != 0
    assert "does not exist" in capsys.readouterr().err
