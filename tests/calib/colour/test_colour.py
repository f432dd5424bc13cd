"""Colours of a simulated camera with a known matrix, under two lights, from pictures of a ColorChecker."""

import json
import warnings

import cv2
import numpy as np
import pytest

from calib.calibration import load_calibration
from calib.colour.chart import ChartProblem, ChartReading, find_chart, read_chart
from calib.colour.fit import apply_matrix, fit_colour
from calib.colour.reference import PLACES, delta_e, lab_of, load_reference
from calib.colour.save import room_white
from calib.errors import ColourError
from calib.flash.pairs import linear_picture
from capture.images import write_png
from capture.response import Response
from capture.transfer import to_display
from relight.commands.calibrate import add_arguments

REFERENCE = load_reference("after 2014")
SRGB = Response("srgb")
# Linear sRGB -> camera RGB, as cameras have it: channels that overlap.
CAMERA = np.array([[0.70, 0.24, 0.06], [0.20, 0.68, 0.12], [0.05, 0.25, 0.70]])
FLASH, ROOM = np.array([1.0, 0.95, 0.80]), np.array([0.75, 0.95, 1.1])  # of the lights, in sRGB
SIZE = (640, 420)
QUAD = np.array([[120, 60], [540, 75], [525, 350], [110, 335]], np.float32)


def chart(patches, px=40, gap=6):
    """[H, W, 3] of 24 patches on black."""
    picture = np.full((4 * (px + gap) + gap, 6 * (px + gap) + gap, 3), 0.02)
    for number, patch in enumerate(patches):
        row, column = divmod(number, 6)
        y, x = gap + row * (px + gap), gap + column * (px + gap)
        picture[y : y + px, x : x + px] = patch
    return picture


def scene(light, level=0.7, quad=QUAD, mirrored=False, blur_px=0.6, patches=REFERENCE.srgb):
    """Linear camera RGB [H, W, 3] of the chart in a light, before a grey wall."""
    flat = chart(patches)[:, ::-1] if mirrored else chart(patches)
    height, width = flat.shape[:2]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    there = cv2.getPerspectiveTransform(corners, quad)
    on = cv2.warpPerspective(np.ones((height, width)), there, SIZE)[..., None]
    picture = cv2.warpPerspective(flat, there, SIZE) * on + 0.3 * (1 - on)
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    return level * (picture * light) @ CAMERA.T


def taken(linear, seed=0, noise=0.003):
    """8 bits of sRGB."""
    linear = linear + np.random.default_rng(seed).normal(0, noise, linear.shape)
    return np.rint(255 * to_display(np.clip(linear, 0, 1))).astype(np.uint8)


def look(image):
    picture = linear_picture("test", image, SRGB, None, np.inf)
    corners = find_chart(picture)
    return corners if isinstance(corners, ChartProblem) else read_chart(picture, corners)


def expected(light):
    """The matrix that makes this light's white grey and keeps its green."""
    matrix = np.diag(1 / light) @ np.linalg.inv(CAMERA)
    return matrix * (CAMERA @ light)[1]


def perfect(light=FLASH, level=0.7, noise=0.0, seed=0, slope=(0.0, 0.0)):
    """A reading without a picture."""
    patches = level * (REFERENCE.srgb * light) @ CAMERA.T * np.exp(PLACES @ slope)[:, None]
    patches = patches + np.random.default_rng(seed).normal(0, noise, patches.shape)
    return ChartReading("made", patches, np.full((24, 3), noise))


def test_the_reference_is_that_of_the_chart():
    """White has L* 95.2 on the reference sheet of November 2014; its row is grey and darkens step by step."""
    neutral = REFERENCE.lab[18:]
    assert neutral[0, 0] == pytest.approx(95.2, abs=0.1)  # the sheet's D50, here brought to D65
    assert (np.diff(neutral[:, 0]) < -10).all()
    assert np.abs(neutral[:, 1:]).max() < 4
    assert REFERENCE.names[14] == "red"
    assert REFERENCE.srgb[14].argmax() == 0


def test_lab_is_that_of_colour_science():
    colours = np.random.default_rng(0).uniform(0, 1, (50, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

        white = colour.xy_to_XYZ(colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"])
        xyz = colour.sRGB_to_XYZ(colours, apply_cctf_decoding=False)
        theirs = colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(white))
    # The white of the rounded matrix is D65 to four digits.
    assert np.abs(lab_of(colours) - theirs).max() < 0.05
    assert np.isfinite(lab_of(np.array([[-0.1, 0.0, -0.5]]))).all()


@pytest.mark.parametrize("light", [FLASH, ROOM])
def test_a_known_matrix_is_found(light):
    found = fit_colour([perfect(light)])
    assert found.matrix == pytest.approx(expected(light), abs=1e-6)
    assert found.white == pytest.approx((CAMERA @ light) / (CAMERA @ light)[1], abs=1e-6)
    assert found.matrix @ found.white == pytest.approx(np.ones(3), abs=1e-6)
    assert found.errors.fitted.max() < 1e-3
    assert found.errors.left_out.max() < 1e-3
    assert found.reference.edition == "after 2014"
    assert found.uncorrected.mean() > 3
    assert delta_e(lab_of(found.corrected), REFERENCE.lab).max() < 1e-3


def test_light_that_slopes_changes_no_colour():
    found = fit_colour([perfect(slope=(0.2, -0.1)), perfect(level=0.4, slope=(-0.15, 0.05))])
    assert found.matrix == pytest.approx(expected(FLASH), abs=1e-4)
    assert found.slopes == pytest.approx([np.hypot(0.2, 0.1), np.hypot(0.15, 0.05)], abs=1e-3)
    with pytest.raises(ColourError, match="middle to its end"):
        fit_colour([perfect(slope=(0.6, 0.0))])


def test_the_stated_uncertainty_holds_the_truth_as_often_as_it_says():
    inside, total = 0, 0
    for seed in range(40):
        found = fit_colour([perfect(noise=0.002, seed=seed)], "after 2014")
        inside += int((np.abs(found.matrix - expected(FLASH)) < 1.96 * found.sigma).sum())
        total += 9
    # Dark patches are the noisiest in CIELAB and weigh as the others, so the spread of all is not that of
    # each: 95 % within some percent, of 360 numbers that go together in nines.
    assert 0.88 < inside / total <= 1.0


def test_another_edition_is_told():
    other = load_reference("before 2014")
    patches = 0.7 * (other.srgb * FLASH) @ CAMERA.T
    found = fit_colour([ChartReading("old", patches, np.zeros((24, 3)))])
    assert found.reference.edition == "before 2014"
    with pytest.raises(ColourError, match="edition"):
        fit_colour([perfect()], "2031")


@pytest.mark.parametrize("turns", [0, 1, 2])
def test_a_chart_is_found_as_it_is_turned(turns):
    image = np.ascontiguousarray(np.rot90(taken(scene(FLASH)), turns))
    reading = look(image)
    assert isinstance(reading, ChartReading)
    truth = 0.7 * (REFERENCE.srgb * FLASH) @ CAMERA.T
    # Noise of 0.003 over some 400 pixels, and the rounding of 8 bits, dithered by it.
    assert np.abs(reading.patches - truth).max() < 0.004
    assert fit_colour([reading]).errors.left_out.mean() < 1.0


def test_bad_pictures_are_refused_with_a_reason():
    assert look(taken(scene(FLASH, mirrored=True))) is ChartProblem.MIRRORED
    assert look(taken(scene(FLASH, level=1.4))) is ChartProblem.CLIPPED
    assert look(taken(scene(FLASH, blur_px=12.0))) in (ChartProblem.NOT_FOUND, ChartProblem.UNEVEN)
    half = QUAD - np.array([330, 0], np.float32)
    assert look(taken(scene(FLASH, quad=half))) is ChartProblem.NOT_FOUND
    assert look(np.full((200, 300, 3), 90, np.uint8)) is ChartProblem.NOT_FOUND
    tiny = np.array([300, 200], np.float32) + (QUAD - QUAD[0]) * 0.12
    assert look(taken(scene(FLASH, quad=tiny))) in (ChartProblem.NOT_FOUND, ChartProblem.SMALL)
    dark = look(taken(scene(FLASH, level=0.03), noise=0.0005))
    assert isinstance(dark, ChartProblem) or dark.dark


def test_patches_of_no_color_checker_are_refused():
    rng = np.random.default_rng(3)
    wrong = ChartReading("wrong", rng.uniform(0.05, 0.8, (24, 3)), np.zeros((24, 3)))
    with pytest.raises(ColourError, match="not those of a ColorChecker"):
        fit_colour([wrong])
    upside_down = ChartReading("turned", perfect().patches[::-1], np.zeros((24, 3)))
    with pytest.raises(ColourError):
        fit_colour([upside_down])
    with pytest.raises(ColourError, match="no picture"):
        fit_colour([])


def run(*arguments):
    import argparse

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args([str(argument) for argument in arguments])
    args.part(args)


def test_pairs_tell_both_lights(tmp_path, capsys):
    folder = tmp_path / "pairs"
    folder.mkdir()
    room, both = scene(ROOM, 0.25), scene(ROOM, 0.25) + scene(FLASH, 0.5)
    for number in range(2):
        write_png(folder / f"{number}_noflash.png", taken(room, 2 * number))
        write_png(folder / f"{number}_flash.png", taken(both, 2 * number + 1))
    run("colour", folder, "--out", tmp_path / "calibration.json")
    known = load_calibration(tmp_path / "calibration.json")
    # Half a percent of noise after averaging; the matrix's own sigma says about as much.
    assert np.abs(known.colour.value - expected(FLASH)).max() < 5 * known.colour.sigma.max()
    assert np.abs(known.colour.value - expected(FLASH)).max() < 0.05
    truth = ROOM / FLASH
    assert known.room_white.value == pytest.approx(truth / truth.mean(), abs=0.02)
    said = capsys.readouterr().out
    assert "CIEDE2000" in said
    assert "root-polynomial" in said
    evidence = json.loads((tmp_path / "calibration.colour.json").read_text())
    assert len(evidence["flash"]["delta_e"]["matrix_left_out"]) == 24
    # Another time only the room: what was known of the room's colour by the old matrix goes.
    write_png(tmp_path / "room.png", taken(scene(ROOM)))
    run("colour", tmp_path / "room.png", "--light", "room", "--out", tmp_path / "calibration.json")
    known = load_calibration(tmp_path / "calibration.json")
    assert known.room_white is None
    assert np.abs(known.colour.value - expected(ROOM)).max() < 0.05
    assert "taken for that of the room" in capsys.readouterr().out


def test_a_source_that_tells_nothing_is_refused(tmp_path):
    write_png(tmp_path / "wall.png", np.full((120, 160, 3), 90, np.uint8))
    with pytest.raises(ColourError, match="no ColorChecker was found"):
        run("colour", tmp_path / "wall.png", "--light", "flash", "--out", tmp_path / "c.json")
    with pytest.raises(ColourError, match="--light"):
        run("colour", tmp_path / "wall.png", tmp_path / "wall.png", "--out", tmp_path / "c.json")
    assert not (tmp_path / "c.json").exists()


def test_white_of_equal_lights_is_grey():
    both = fit_colour([perfect()])
    assert room_white(both, both) == pytest.approx(np.ones(3), abs=1e-6)
    assert apply_matrix(np.eye(3), np.ones((2, 3))).tolist() == [[1, 1, 1]] * 2
