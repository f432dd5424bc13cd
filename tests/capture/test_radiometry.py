"""Dark level, response, flat field and colour are taken off as they were put on."""

import json
import logging

import numpy as np
import pytest

from capture.errors import CalibrationError
from capture.frame_record import FrameRecord
from capture.radiometry import Radiometry
from capture.response import Response
from capture.session import Session
from capture.transfer import to_linear

DARK = np.array([0.06, 0.05, 0.07])
FLAT = np.array([-0.4, 0.05])
COLOUR = np.array([[1.6, -0.4, -0.2], [-0.3, 1.5, -0.2], [0.0, -0.6, 1.6]])
SIZE = (48, 32)


def passed(u, v):
    """By the definition, at a pixel's centre."""
    half = 0.5 * np.hypot(*SIZE)
    r2 = ((u + 0.5 - SIZE[0] / 2) ** 2 + (v + 0.5 - SIZE[1] / 2) ** 2) / half**2
    return 1 + FLAT[0] * r2 + FLAT[1] * r2**2


def scene():
    return np.random.default_rng(1).uniform(0.05, 0.8, (SIZE[1], SIZE[0], 3))


def photographed(radiance):
    """16 bits of a camera with a square-root curve above its dark level."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    exposure = np.linalg.solve(COLOUR, radiance[..., None])[..., 0] * passed(u, v)[..., None]
    stored = DARK + (1 - DARK) * np.sqrt(np.clip(exposure, 0, 1))
    return np.rint(65535 * stored).astype(np.uint16)


# The table of a square root above the dark level, fine enough that its chords are within 1e-5.
STORED = np.linspace(0, 0.95, 4001)
TABLE = Response(None, STORED, np.stack([np.minimum(STORED / (1 - d), 1) ** 2 for d in DARK], axis=1))


def header(**entries):
    return json.dumps({"schema": "relight-calibration", "version": 1, **entries})


def entry(value, **made_with):
    return {"value": np.asarray(value).tolist(), "unit": "1", "sigma": None, "source": "test"} | (
        {"made_with": made_with} if made_with else {}
    )


@pytest.fixture
def session(tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "test"}, width=SIZE[0], height=SIZE[1]) as made:
        file = made.write_frame(0, photographed(scene()))
        made.append_frame(FrameRecord(index=0, file=file, width=SIZE[0], height=SIZE[1], gain=2.0))
    return tmp_path / "S"


def test_radiance_is_what_the_scene_sent(session):
    response = TABLE.to_json()
    everything = header(response=response, dark=entry(DARK), flat_field=entry(FLAT), colour=entry(COLOUR))
    (session / "calibration.json").write_text(everything)
    opened = Session.open(session)
    found = opened.load_radiance(opened.frames[0])
    # Half a code of 16 bits is 8e-6 of the stored value, twice that of the exposure, times the colour matrix
    # and the lens; the table's chords add as much.
    assert np.abs(found - scene()).max() < 2e-4
    assert found.dtype == np.float32


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_part_that_is_not_known_changes_no_bit(kind):
    image = np.random.default_rng(2).integers(0, np.iinfo(kind).max + 1, (9, 7, 3)).astype(kind)
    plain = Radiometry(Response("srgb"))
    exposure = plain.exposure(image)
    assert np.array_equal(exposure, to_linear(image, "srgb"))
    assert plain.radiance(exposure) is exposure
    assert (plain.white == 1).all()


def test_white_is_where_the_highest_code_comes_out():
    known = Radiometry(Response("srgb"), DARK)
    image = np.full((2, 2, 3), 255, np.uint8)
    assert np.allclose(known.exposure(image), known.white, rtol=1e-6)
    assert (known.white < 0.95).all()  # without its own limit a clipped pixel would pass for a measurement


def test_noise_about_black_averages_to_nothing():
    """Cut off at the dark level, it would leave 0.4 of its standard deviation."""
    stored = 0.2 + np.random.default_rng(3).normal(0, 0.01, (200, 200, 1))
    image = np.rint(65535 * np.repeat(stored, 3, axis=2)).astype(np.uint16)
    known = Radiometry(Response("linear"), np.full(3, 0.2))
    assert abs(known.exposure(image).mean()) < 4 * 0.01 / 200  # of 40,000 pixels


def test_the_lens_passes_what_its_terms_say_at_every_pixel():
    known = Radiometry(Response("linear"), flat_field=FLAT)
    share = known.passed(SIZE[1], SIZE[0])
    for v, u in ((0, 0), (15, 23), (31, 47), (4, 40)):
        assert share[v, u] == pytest.approx(passed(u, v), rel=1e-6)
    assert share.argmax() in (15 * 48 + 23, 15 * 48 + 24, 16 * 48 + 23, 16 * 48 + 24)
    dark_corner = Radiometry(Response("linear"), flat_field=np.array([-1.5]))
    assert dark_corner.passed(40, 40).min() == np.float32(0.05)


def test_what_was_made_with_other_settings_is_left_out_with_one_warning(session, caplog):
    (session / "calibration.json").write_text(
        header(dark=entry(DARK, gain=2.0), flat_field=entry(FLAT, width=64, height=32), colour=entry(COLOUR))
    )
    opened = Session.open(session)
    with caplog.at_level(logging.WARNING):
        radiometry = opened.radiometry
        _, warning = opened.read_calibration()
        opened.load_radiance(opened.frames[0])
    assert radiometry.flat_field is None
    assert np.array_equal(radiometry.dark, DARK)
    assert np.array_equal(radiometry.colour, COLOUR)
    assert "flat_field (the frames are 48 pixels wide, not 64)" in warning
    assert len(caplog.records) == 1
    (session / "calibration.json").write_text(header(dark=entry(DARK, gain=8.0)))
    opened = Session.open(session)
    assert opened.radiometry.dark is None
    frame = opened.load_image(opened.frames[0])
    assert np.array_equal(opened.load_radiance(opened.frames[0]), to_linear(frame, "srgb"))


def test_float_frames_are_exposure_already(tmp_path):
    picture = np.full((SIZE[1], SIZE[0], 3), 0.5, np.float32)
    with Session.create(tmp_path / "S", source={"kind": "raw"}, width=SIZE[0], height=SIZE[1]) as made:
        file = made.write_frame(0, picture, ".exr")
        made.append_frame(FrameRecord(index=0, file=file, width=SIZE[0], height=SIZE[1]))
    (tmp_path / "S" / "calibration.json").write_text(
        header(dark=entry(DARK), response=TABLE.to_json(), flat_field=entry(FLAT))
    )
    opened = Session.open(tmp_path / "S")
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    assert np.allclose(opened.load_radiance(opened.frames[0])[..., 0], 0.5 / passed(u, v), rtol=1e-6)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"dark": entry([0.1, 0.1])}, "shape"),
        ({"colour": entry(np.eye(3).tolist()) | {"unit": "m"}}, "unit"),
        ({"flat_field": entry(FLAT) | {"made_with": {"zoom": 2}}}, "zoom"),
        ({"flat_field": entry(FLAT) | {"made_with": 3}}, "object"),
    ],
)
def test_entries_that_cannot_be_are_refused(session, entries, said):
    (session / "calibration.json").write_text(header(**entries))
    opened = Session.open(session)
    with pytest.raises(CalibrationError, match=said):
        opened.load_radiance(opened.frames[0])
