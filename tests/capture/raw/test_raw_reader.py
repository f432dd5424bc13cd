"""RAW files as radiance: a known picture written as a DNG is found again to half a code."""

import struct
from datetime import datetime

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.errors import ImageError
from capture.images import encode_image
from capture.raw.levels import Levels, clipped_samples
from capture.raw.libraw import touched_by
from capture.raw.reader import RawFile, read_raw
from capture.raw.tiff import read_directories

WHITE = 4095
BLACK = ((60.0, 62.5), (64.25, 70.0))
HALF_CODE = 0.5 / (WHITE - 70.0)  # of radiance: what rounding to codes may cost
STEP = 1.5 / 65535  # LibRaw's 16 bits over a range of up to 2.2, half a step of rounding, and float32


def textured(height=32, width=40, seed=0):
    """[H, W, 3] radiance in 0.02..0.9."""
    return np.random.default_rng(seed).uniform(0.02, 0.9, (height, width, 3))


def read(tmp_path, data, **options):
    path = tmp_path / "picture.dng"
    path.write_bytes(data)
    return read_raw(path, **options)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_every_sample_is_found_to_half_a_code(make, tmp_path, order, pattern):
    mosaic = make.mosaic_of(textured(), pattern)
    codes = make.codes_of(mosaic, BLACK, WHITE)
    picture = read(tmp_path, make.dng(codes, order=order, pattern=pattern, black=BLACK, white=WHITE))
    assert np.abs(make.mosaic_of(picture.radiance, pattern) - mosaic).max() <= HALF_CODE + STEP
    assert picture.radiance.dtype == np.float32
    assert not picture.clipped.any()
    assert picture.facts.cfa == pattern
    assert picture.facts.black == (60.0, 62.5, 64.25, 70.0)
    assert picture.facts.white == (WHITE,)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_flat_colours_are_found_in_every_pixel_and_white_balance_multiplies_them(make, tmp_path, pattern):
    colour = np.array([0.31, 0.57, 0.12])
    codes = make.codes_of(make.mosaic_of(np.broadcast_to(colour, (32, 40, 3)), pattern), BLACK, WHITE)
    data = make.dng(codes, pattern=pattern, black=BLACK, white=WHITE)
    # Interpolation adds differences to samples: what is rounded may double.
    assert np.abs(read(tmp_path, data).radiance - colour).max() <= 2 * HALF_CODE
    balance = np.array([2.0, 1.0, 1.6])
    assert (
        np.abs(read(tmp_path, data, white_balance=balance).radiance - colour * balance).max() <= 4 * HALF_CODE
    )
    with pytest.raises(ValueError, match="at least 1"):
        read(tmp_path, data, white_balance=(0.5, 1, 1))


def test_noise_below_black_stays_negative(make, tmp_path):
    codes = np.random.default_rng(3).normal(64, 5, (64, 64)).round().astype(np.uint16)
    picture = read(tmp_path, make.dng(codes, black=64.0, white=WHITE))
    # 4096 samples of 5 codes: the mean is known to 5 / 64 codes; three times that
    assert abs(make.mosaic_of(picture.radiance).mean()) < 3 * 5 / 64 / WHITE
    assert picture.radiance.min() < 0


def test_a_linearization_table_is_applied_before_the_levels(make, tmp_path):
    table = np.round(4000 + 40 * np.sqrt(np.arange(1024)) * 32).astype(int)  # any curve that rises
    codes = np.random.default_rng(4).integers(0, 1024, (32, 32))
    picture = read(tmp_path, make.dng(codes, table=table, black=4000.0, white=50000))
    expected = (table[codes] - 4000) / 46000
    below = expected < 1
    assert np.abs(make.mosaic_of(picture.radiance) - expected)[below].max() < STEP


def test_blacks_by_row_and_column_are_subtracted(make, tmp_path):
    rng = np.random.default_rng(5)
    rows, columns = rng.uniform(0, 30, 32).round(), rng.uniform(-20, 20, 40).round()
    codes = rng.integers(300, 3500, (32, 40))
    data = make.dng(codes, black=64.0, white=WHITE, delta_v=rows, delta_h=columns)
    expected = (codes - 64 - rows[:, None] - columns) / (WHITE - 64 - rows.max() - columns.max())
    assert np.abs(make.mosaic_of(read(tmp_path, data).radiance) - expected).max() < STEP


@pytest.mark.parametrize("corner", [(0, 0), (4, 6), (3, 5), (2, 3)])
def test_only_the_active_area_is_the_picture_and_its_colours_begin_there(make, tmp_path, corner):
    top, left = corner
    mosaic = make.mosaic_of(textured(), "GRBG")
    codes = np.full((40, 52), 7, np.uint16)
    codes[top : top + 32, left : left + 40] = make.codes_of(mosaic, 64.0, WHITE)
    data = make.dng(codes, pattern="GRBG", black=64.0, white=WHITE, active=(top, left, top + 32, left + 40))
    picture = read(tmp_path, data)
    assert picture.facts.cfa == "GRBG"
    # LibRaw starts at even rows and columns: those before are left out as if they were clipped.
    assert not picture.clipped[top % 2 :, left % 2 :].any()
    assert picture.clipped[: top % 2].all()
    assert picture.clipped[:, : left % 2].all()
    error = np.abs(make.mosaic_of(picture.radiance, "GRBG") - mosaic)
    assert error[~picture.clipped].max() <= HALF_CODE + STEP


def shading(height, width):
    """[H, W] gain of a lens's shading, exactly bilinear on a 3 x 3 grid from edge to edge; and the grid."""
    grid = np.array([[3.0, 2.0, 2.5], [1.5, 1.0, 1.25], [2.0, 1.5, 3.5]])
    y, x = (2 * (np.arange(n) + 0.5) / n for n in (height, width))
    tents = [np.maximum(0, 1 - np.abs(at[:, None] - np.arange(3))) for at in (y, x)]
    return tents[0] @ grid @ tents[1].T, grid


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_a_lens_shading_is_undone_by_the_gain_maps_of_the_mosaic(make, tmp_path, order, pattern):
    truth = textured() * 1.5  # above 1 where the shaded sample is below
    gain, grid = shading(32, 40)
    places = [(y, x) for y in (0, 1) for x in (0, 1)]
    by_phase = {place: 1 + 0.1 * k for k, place in enumerate(places)}  # each colour plane has its own
    scale = np.tile(np.array([by_phase[p] for p in places]).reshape(2, 2), (16, 20))
    maps = [make.gain_map(grid * by_phase[p], (*p, 32, 40), pitch=(2, 2)) for p in places]
    mosaic = make.mosaic_of(truth, pattern)
    codes = make.codes_of(mosaic / (gain * scale), BLACK, WHITE)
    common = {"order": order, "pattern": pattern, "black": BLACK, "white": WHITE}
    picture = read(tmp_path, make.dng(codes, opcodes2=make.opcode_list(*maps), **common))
    valid = ~picture.clipped
    error = np.abs(make.mosaic_of(picture.radiance, pattern) - mosaic) / (gain * scale)
    assert error[valid].max() <= HALF_CODE + STEP
    assert picture.radiance[valid].max() > 1.2  # not cut at the clip of the shaded samples
    assert picture.facts.applied == ("GainMap",) * 4
    assert picture.facts.largest_gain == pytest.approx(3.5 * 1.3)
    without = read(tmp_path, make.dng(codes, **common))
    assert np.abs(make.mosaic_of(without.radiance, pattern) - mosaic).max() > 0.2
    assert np.array_equal(without.clipped, picture.clipped)


def test_gain_maps_and_vignettes_after_demosaicing_are_applied_too(make, tmp_path):
    colour = np.array([0.1, 0.2, 0.15])
    codes = make.codes_of(make.mosaic_of(np.broadcast_to(colour, (32, 40, 3))), 64.0, WHITE)
    gain, grid = shading(32, 40)
    opcodes = make.opcode_list(
        make.gain_map(grid, (0, 0, 32, 40), plane=1), make.vignette((0.5, 0, 0, 0, 0)), make.opcode(1, b"x")
    )
    picture = read(tmp_path, make.dng(codes, black=64.0, white=WHITE, opcodes3=opcodes))
    y, x = np.mgrid[0:32, 0:40] + 0.5
    vignette = 1 + 0.5 * ((x - 20) ** 2 + (y - 16) ** 2) / (20**2 + 16**2)
    expected = (
        colour * vignette[..., None] * np.stack([np.ones_like(gain), gain, np.ones_like(gain)], axis=-1)
    )
    assert np.abs(picture.radiance / expected - 1).max() < 2 * HALF_CODE / 0.1
    assert picture.facts.applied == ("GainMap", "VignetteRadial")
    assert picture.facts.left_out == ("WarpRectilinear",)
    assert picture.facts.warnings == ()
    small = RawFile.open(tmp_path / "picture.dng").small()
    np.testing.assert_allclose(small, expected[1::2, 1::2], rtol=0.05)


def test_opcodes_that_may_not_be_left_out_are_a_warning(make, tmp_path):
    data = make.dng(np.full((32, 32), 900), opcodes2=make.opcode_list(make.opcode(8, bytes(60), flags=0)))
    (sentence,) = read(tmp_path, data).facts.warnings
    assert "MapPolynomial" in sentence


def test_what_a_clipped_sample_has_gone_into_is_known_and_nothing_else(make, tmp_path):
    truth = textured()
    truth[10, 12] = 1.7
    truth[20:24, 30:33] = 1.0
    mosaic = make.mosaic_of(truth)
    picture = read(tmp_path, make.dng(make.codes_of(mosaic, BLACK, WHITE), black=BLACK, white=WHITE))
    assert np.array_equal(picture.clipped, touched_by(mosaic >= 0.99, np.array([[0, 1], [1, 2]])))
    assert picture.clipped[10, 12]
    assert picture.radiance[10, 12].max() >= 1 - HALF_CODE
    assert picture.clipped.sum() > 51  # the cross that one sample reaches


def test_facts_are_those_of_the_file(make, tmp_path):
    codes = np.full((32, 48), 1000, np.uint16)
    data = make.dng(
        codes, exposure_s=1 / 125, iso=400, time="2026:03:04 05:06:07", subsec="25", orientation=6
    )
    facts = read(tmp_path, data).facts
    assert facts.camera == "Maker Model 1"
    assert (facts.width, facts.height, facts.rotation_deg) == (48, 32, 90)
    assert facts.taken == datetime(2026, 3, 4, 5, 6, 7, 250000)
    assert facts.exposure_s == pytest.approx(1 / 125, rel=1e-5)  # the rational in the file is in 2^-24
    assert (facts.iso, facts.aperture, facts.focal_length_mm) == (400, 2.0, 5.5)
    assert facts.light == pytest.approx(4 / 125 / 4, rel=1e-5)
    assert facts.white_balance == pytest.approx((2.0, 1.0, 1.6), rel=1e-5)
    assert facts.camera_from_xyz == pytest.approx((0.9, -0.2, -0.1, -0.4, 1.2, 0.2, -0.1, 0.2, 0.6))
    for orientation, turn in ((1, 0), (3, 180), (8, 270)):
        facts = read(tmp_path, make.dng(codes, orientation=orientation, time="0000:00:00 00:00:00")).facts
        assert (facts.width, facts.height, facts.rotation_deg) == (48, 32, turn)
        assert facts.taken is None


def test_a_picture_that_is_demosaiced_already_is_taken_as_it_is(make, tmp_path):
    codes = np.random.default_rng(6).integers(100, 4000, (32, 40, 3))
    codes[5, 6, 1] = WHITE
    gain, grid = shading(32, 40)
    opcodes = make.opcode_list(make.gain_map(grid, (0, 0, 32, 40), planes=3))
    picture = read(tmp_path, make.dng(codes, black=[[64.0, 60.0, 62.5]], white=WHITE, opcodes2=opcodes))
    black = np.array([64, 60, 62.5])
    np.testing.assert_allclose(
        picture.radiance, (codes - black) / (WHITE - black) * gain[..., None], rtol=2e-6, atol=STEP
    )
    assert picture.clipped.nonzero() == (np.array([5]), np.array([6]))
    assert picture.facts.cfa == ""


def test_a_lossy_dng_is_as_libraw_undoes_its_curve(make, tmp_path):
    codes = np.array([120, 200, 60], np.uint8)
    jpeg = encode_image(np.broadcast_to(codes, (32, 48, 3)).copy(), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 100])
    curve = [
        make.opcode(8, struct.pack(">9I3d", 0, 0, 32, 48, plane, 1, 1, 1, 2, 0.0, 0.2, 0.8), flags=0)
        for plane in range(3)
    ]
    raw = {
        254: (4, [0]),
        256: (4, [48]),
        257: (4, [32]),
        258: (3, [8, 8, 8]),
        259: (3, [34892]),
        262: (3, [34892]),
        277: (3, [3]),
        278: (4, [32]),
        50717: (4, [255] * 3),
        51009: (7, make.opcode_list(*curve)),
    }
    main = {271: (2, "Maker"), 272: (2, "Model 1"), 50706: (1, [1, 4, 0, 0]), 50708: (2, "Model 1")}
    picture = read(tmp_path, make.tiff("<", {"main": main, "raw": raw}, jpeg))
    stored = codes / 255
    # a JPEG is right to a code or two, and the curve's slope is at most 1.8
    assert np.abs(picture.radiance - (0.2 * stored + 0.8 * stored**2)).max() < 2 * 1.8 / 255
    assert picture.facts.warnings == ()


def test_an_x_trans_mosaic_goes_through_libraw(make, tmp_path):
    colour = np.array([0.31, 0.57, 0.12])
    truth = np.broadcast_to(colour, (516, 516, 3)).copy()  # LibRaw's tiles are 512
    truth[200:203, 300:303] = 1.5
    codes = make.codes_of(make.mosaic_of(truth, "XTRANS"), 64.0, WHITE)
    balance = np.array([2.0, 1.0, 1.6])
    picture = read(
        tmp_path, make.dng(codes, pattern="XTRANS", black=64.0, white=WHITE), white_balance=balance
    )
    assert picture.facts.cfa == "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"
    # beside the codes, LibRaw's 16 bits of the range up to 2
    error = np.abs(picture.radiance - colour * balance)[~picture.clipped]
    assert error.max() <= 2 * HALF_CODE + 2 / 65535
    assert picture.clipped[198:205, 298:305].all()
    assert picture.clipped.sum() < 300


def test_an_x_trans_mosaic_that_is_too_small_for_libraw_is_one_sentence(make, tmp_path):
    with pytest.raises(ImageError, match=r"picture\.dng cannot be developed: LibRaw says"):
        read(tmp_path, make.dng(np.full((36, 36), 900), pattern="XTRANS"))


def test_a_sensor_without_colours_gives_grey(make, tmp_path):
    codes = np.random.default_rng(9).integers(100, 4000, (32, 40)).astype(np.uint16)
    data = make.dng(codes, black=64.0, white=WHITE, extra={262: (3, [34892])})
    picture = read(tmp_path, data, white_balance=(2.0, 1.0, 1.6))
    expected = np.repeat(((codes - 64.0) / (WHITE - 64))[..., None], 3, axis=2)
    np.testing.assert_allclose(picture.radiance, expected, atol=STEP)
    assert picture.facts.cfa == ""


def test_without_a_stated_white_level_a_pile_of_samples_at_the_top_is_the_clip(make, tmp_path):
    rng = np.random.default_rng(7)
    stored = rng.integers(200, 15000, (60, 60)).astype(np.uint16)
    stored[20:28, 20:28] = 15100  # 64 samples below LibRaw's 16383
    zero = np.zeros((1, 1, 1), np.float32)
    levels = Levels(zero, zero[0, 0, :0], zero[0, 0, :0], np.array([16383.0], np.float32), stated=False)
    assert np.array_equal(clipped_samples(stored, levels.linear(stored), levels), stored == 15100)
    stored[20:28, 20:28] = 100
    assert not clipped_samples(stored, levels.linear(stored), levels).any()


def test_levels_that_a_dng_leaves_out_are_libraws(make, tmp_path):
    codes = np.random.default_rng(8).integers(0, 60000, (32, 32)).astype(np.uint16)
    data = bytearray(make.dng(codes))
    raw = next(d for d in read_directories(bytes(data)) if 50717 in d)
    place = raw.fields[50717][2] - 8
    data[place : place + 2] = (50999).to_bytes(2, "little")  # WhiteLevel becomes a tag that nobody knows
    picture = read(tmp_path, bytes(data))
    assert picture.facts.white == (65535,)
    assert np.abs(make.mosaic_of(picture.radiance) - codes / 65535).max() < STEP


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: b"", "LibRaw says"),
        (lambda data: b"no RAW at all" * 100, "LibRaw says"),
        (lambda data: data[: len(data) // 2], "should reach to byte|LibRaw says"),
        (lambda data: data[:-1], "should reach to byte"),
        (lambda data: data[:100], "read as RAW"),
    ],
)
def test_a_damaged_file_is_one_sentence(make, tmp_path, damage, words):
    with pytest.raises(ImageError, match=words) as raised:
        read(tmp_path, damage(make.dng(np.full((32, 32), 900, np.uint16))))
    assert str(raised.value).startswith(str(tmp_path / "picture.dng"))
    assert "\n" not in str(raised.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ImageError, match=r"nowhere\.dng cannot be read: No such file"):
        read_raw(tmp_path / "nowhere.dng")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"black": 5000.0, "white": 4000}, "white level"),
        ({"opcodes2": b"\xff" * 40}, "opcodes"),
        ({"opcodes3": b""}, "opcode list of 0 bytes"),
        ({"active": (0, 0, 99, 99)}, "ActiveArea|LibRaw says"),
        ({"active": (8, 8, 12, 30)}, "less than any sensor|LibRaw says"),
        ({"extra": {50717: (3, [])}}, "white level is empty"),
        ({"extra": {50713: (3, [0, 0])}}, "BlackLevelRepeatDim"),
        ({"extra": {50713: (3, [5, 5])}}, "BlackLevel has"),
        ({"black": BLACK, "delta_v": [1.0] * 5}, "5 values for 32"),
    ],
)
def test_tags_that_cannot_be_are_one_sentence(make, tmp_path, changes, words):
    with pytest.raises(ImageError, match=words):
        read(tmp_path, make.dng(np.full((32, 32), 900, np.uint16), **({"black": BLACK} | changes)))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_bytes_changed_at_random_give_a_sentence_or_a_picture(make, tmp_path, data):
    whole = bytearray(
        make.dng(
            np.full((32, 32), 900, np.uint16),
            black=BLACK,
            opcodes2=make.opcode_list(make.gain_map([[1.0, 2.0], [2.0, 3.0]], (0, 0, 32, 32))),
        )
    )
    head = len(whole) - 32 * 32 * 2  # what is not pixels
    for _ in range(data.draw(st.integers(1, 8))):
        whole[data.draw(st.integers(0, head - 1))] = data.draw(st.integers(0, 255))
    try:
        picture = read(tmp_path, bytes(whole))
    except ImageError:
        return
    assert picture.radiance.shape == (picture.facts.height, picture.facts.width, 3)
