"""A known fall-off is found again under uneven light, with its uncertainty; bad flats are refused."""

import numpy as np
import pytest

from calib.calibration import load_calibration
from calib.errors import FlatFieldError
from calib.sensor.flat_field import fit_flat_field
from calib.stills import Still
from capture.controls import Controls
from capture.images import write_png
from capture.response import Response
from capture.sim.sensor import SensorConfig
from relight.cli import main

TERMS = np.array([-0.45, 0.12, -0.03])
RADII = np.array([0.3, 0.6, 0.9])
SRGB = Response("srgb")


def flat(seed, terms=TERMS, slope=0.1, bowl=0.0, level=0.6, texture=0.0):
    """A picture of a wall under light that slopes in a random direction and has a random bowl."""
    rng = np.random.default_rng(seed)
    height, width = 180, 240
    y, x = np.mgrid[0:height, 0:width]
    half = np.hypot(height, width) / 2
    x, y = (x + 0.5 - width / 2) / half, (y + 0.5 - height / 2) / half
    r2 = x * x + y * y
    angle, bent = rng.uniform(0, 2 * np.pi), bowl * rng.standard_normal(3)
    light = 1 + slope * (np.cos(angle) * x + np.sin(angle) * y)
    light = light + bent[0] * (x * x - y * y) + bent[1] * 2 * x * y + bent[2] * r2
    light = light * (1 + texture * np.sin(40 * x) * np.sin(33 * y))
    passed = 1 + terms[0] * r2 + terms[1] * r2**2 + terms[2] * r2**3
    radiance = level * (light * passed)[..., None] * np.array([0.9, 1.0, 0.7])
    return Still(f"flat {seed}", SensorConfig(seed=seed).develop(radiance, 0), None)


def truth(radii=RADII):
    return 1 + sum(term * radii ** (2 * k) for k, term in enumerate(TERMS, start=1))


def test_one_flat_under_sloping_light_is_enough_where_the_light_has_no_bowl():
    off = []
    for seed in range(6):
        passed, sigma = fit_flat_field([flat(seed)], SRGB).passed(RADII)
        off.append((passed - truth()) / sigma)
        assert np.abs(passed - truth()).max() < 0.001
    # 6 pictures at 3 radii that go together, about 10 numbers: rms 1 +- 0.22.
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.8


@pytest.mark.parametrize("count", [1, 5])
def test_the_light_s_bowl_is_in_the_uncertainty(count):
    off, sigmas = [], []
    for seed in range(10):
        flats = [flat(100 * seed + number, bowl=0.02) for number in range(count)]
        passed, sigma = fit_flat_field(flats, SRGB).passed(RADII)
        off.append((passed - truth()) / sigma)
        sigmas.append(sigma[-1])
    # The bowl's size is told by two numbers a picture: with one picture, rms is known to a factor of two.
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 2.0
    # 0.02 at r = 1, times r^2 = 0.81, over the root of the number of pictures.
    assert np.median(sigmas) == pytest.approx(0.02 * 0.81 / np.sqrt(count), rel=0.6)


def test_few_flats_are_told():
    assert "One picture does not tell" in fit_flat_field([flat(1)], SRGB).warnings[0]
    assert not fit_flat_field([flat(seed) for seed in range(3)], SRGB).warnings


@pytest.mark.parametrize(
    ("flats", "words"),
    [
        (list, "no pictures"),
        (lambda: [flat(3, level=1.5)], "clipped"),
        (lambda: [flat(3, level=0.01)], "too dark"),
        (lambda: [flat(3, texture=0.05)], "plain surface"),
        (lambda: [flat(3, slope=0.6)], "unevenly"),
        (lambda: [flat(3, bowl=0.2)], "unevenly"),
        (lambda: [flat(3, terms=np.array([0.4, 0.0, 0.0]))], "no lens does that"),
        (lambda: [flat(3), Still("x", flat(3).image[:90], None)], "different sizes"),
        (lambda: [Still("x", flat(3).image[:20, :20], None)], "at least 32"),
    ],
)
def test_a_picture_that_is_no_flat_is_refused(flats, words):
    with pytest.raises(FlatFieldError, match=words):
        fit_flat_field(flats(), SRGB)


def test_the_command_saves_what_it_finds(tmp_path, capsys, read_page):
    folder = tmp_path / "flats"
    folder.mkdir()
    for seed in range(3):
        write_png(folder / f"{seed}.png", flat(seed).image)
    out = tmp_path / "calibration.json"
    assert main(["calibrate", "flat", str(folder), "--out", str(out)]) == 0
    page = read_page(out)
    assert "bowl of light" in page
    assert "as if the terms were independent" not in page
    said = capsys.readouterr().out
    assert "in the corner" in said
    assert said.count("flat  ") == 3
    found = load_calibration(out).flat_field
    assert 1 + found.value.sum() == pytest.approx(1 + TERMS.sum(), abs=0.002)
    assert "srgb (no response is known)" in found.source
    height, width = flat(0).image.shape[:2]
    assert found.made_with == Controls(width=width, height=height)
    write_png(folder / "3.png", flat(3, texture=0.05).image)
    assert main(["calibrate", "flat", str(folder), "--out", str(out)]) == 1
    assert "3.png does not show a plain surface" in capsys.readouterr().err
