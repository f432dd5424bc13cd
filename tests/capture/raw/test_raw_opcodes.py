"""Gain maps and vignettes of DNG opcode lists, against an independent evaluation; malformed lists."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from capture.errors import ImageError
from capture.raw.opcodes import parse_opcodes

HEIGHT, WIDTH = 30, 44


def reference_gain(gain, spacing, origin, row, column):
    """DNG 1.7.1, GainMap: bilinear at pixel centres in parts of the picture, end points held."""
    nodes = [origin[axis] + spacing[axis] * np.arange(gain.shape[axis]) for axis in (0, 1)]
    at = [(row + 0.5) / HEIGHT, (column + 0.5) / WIDTH]
    at = [np.clip(at[axis], nodes[axis][0], nodes[axis][-1]) for axis in (0, 1)]
    found = RegularGridInterpolator(nodes, gain)(np.stack(np.broadcast_arrays(*at), axis=-1))
    return found if np.ndim(row) else found.item()


def grid(shape, seed=0):
    return np.random.default_rng(seed).uniform(0.8, 3.0, shape)


@pytest.mark.parametrize(
    ("spacing", "origin"), [((0.25, 0.2), (0.0, 0.0)), ((0.2, 0.125), (0.1, 0.2)), ((0.6, 0.5), (-0.3, -0.1))]
)
def test_a_gain_map_is_bilinear_between_its_points_and_held_beyond(make, spacing, origin):
    gain = grid((5, 6))
    opcodes = parse_opcodes(
        make.opcode_list(make.gain_map(gain, (0, 0, HEIGHT, WIDTH), spacing=spacing, origin=origin))
    )
    picture = np.ones((HEIGHT, WIDTH), np.float32)
    opcodes.apply(picture)
    expected = reference_gain(gain, spacing, origin, np.arange(HEIGHT)[:, None], np.arange(WIDTH)[None])
    np.testing.assert_allclose(picture, expected, rtol=2e-6)  # float32
    assert opcodes.largest_gain == pytest.approx(gain.max())


def test_area_pitch_and_planes_say_which_samples_are_changed(make):
    gain = grid((3, 4, 2))
    data = make.gain_map(gain, (5, 3, 27, 1000), plane=1, planes=9, pitch=(2, 3))
    picture = np.ones((HEIGHT, WIDTH, 3), np.float32)
    parse_opcodes(make.opcode_list(data)).apply(picture)
    expected = np.ones_like(picture)
    for row in range(5, 27, 2):
        for column in range(3, WIDTH, 3):
            for plane in (1, 2):  # the map's last plane, 1, holds for plane 2 too
                expected[row, column, plane] = reference_gain(
                    gain[..., 1], (1 / 2, 1 / 3), (0, 0), row, column
                )
    np.testing.assert_allclose(picture, expected, rtol=2e-6)
    assert picture.max() > 1.5  # nothing is cut at 1


def test_a_map_of_one_point_is_one_gain_and_an_area_outside_changes_nothing(make):
    picture = np.ones((HEIGHT, WIDTH), np.float32)
    one = make.gain_map([[2.5]], (0, 0, HEIGHT, WIDTH), spacing=(0.0, 0.0))
    outside = make.gain_map([[9.0]], (HEIGHT, 0, HEIGHT + 4, WIDTH))
    empty = make.gain_map([[9.0]], (0, 0, 0, WIDTH))
    parse_opcodes(make.opcode_list(one, outside, empty)).apply(picture)
    assert (picture == 2.5).all()


def test_four_maps_of_a_mosaic_are_one_after_the_other_on_their_own_samples(make):
    maps = [
        make.gain_map([[2.0 + 2 * y + x]], (y, x, HEIGHT, WIDTH), pitch=(2, 2))
        for y in (0, 1)
        for x in (0, 1)
    ]
    picture = np.ones((HEIGHT, WIDTH), np.float32)
    opcodes = parse_opcodes(make.opcode_list(*maps))
    opcodes.apply(picture)
    assert picture[:2, :2].tolist() == [[2, 3], [4, 5]]
    assert opcodes.largest_gain == 5
    both = parse_opcodes(make.opcode_list(*maps, make.vignette((1.0, 0, 0, 0, 0))))
    assert both.largest_gain == 10
    overlapping = parse_opcodes(make.opcode_list(maps[0], make.gain_map([[3.0]], (0, 0, HEIGHT, WIDTH))))
    assert overlapping.largest_gain == 6


def test_a_radial_vignette_is_its_polynomial_of_the_distance_from_its_centre(make):
    k, centre = (0.5, -0.2, 0.1, 0.05, -0.03), (0.4, 0.7)
    opcodes = parse_opcodes(make.opcode_list(make.vignette(k, centre)))
    picture = np.ones((HEIGHT, WIDTH, 3), np.float32)
    opcodes.apply(picture)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    corner = np.hypot(0.6 * WIDTH, 0.7 * HEIGHT)
    r = np.hypot(x - 0.4 * WIDTH, y - 0.7 * HEIGHT) / corner
    expected = 1 + sum(c * r ** (2 * n + 2) for n, c in enumerate(k))
    np.testing.assert_allclose(picture, np.repeat(expected[..., None], 3, axis=2), rtol=2e-6)
    assert picture.max() <= opcodes.largest_gain * (1 + 1e-6)


def test_other_opcodes_are_named_and_those_that_may_not_be_left_out_apart(make):
    opcodes = parse_opcodes(
        make.opcode_list(
            make.opcode(1, bytes(20), flags=1),
            make.opcode(8, bytes(7), flags=0),
            make.opcode(77, b"", flags=2),
            make.gain_map([[1.0]], (0, 0, 1, 1)),
        )
    )
    assert opcodes.left_out == ("WarpRectilinear", "MapPolynomial", "number 77")
    assert opcodes.missed == ("MapPolynomial", "number 77")
    assert len(opcodes.steps) == 1


def absurd(**changes):
    fields = {
        "top": 0,
        "left": 0,
        "bottom": 9,
        "right": 9,
        "plane": 0,
        "planes": 1,
        "row": 1,
        "column": 1,
        "v": 2,
        "h": 2,
    }
    fields |= {"sv": 1.0, "sh": 1.0, "ov": 0.0, "oh": 0.0, "map_planes": 1, "gains": (1.0,) * 4} | changes
    *head, gains = fields.values()
    return struct.pack(">10I4dI", *head) + struct.pack(f">{len(gains)}f", *gains)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (absurd()[:-1], "claims 2 x 2 points"),
        (absurd()[:40], "cut short"),
        (absurd(v=1 << 31, h=1 << 31), "points"),
        (absurd(v=0), "empty grid"),
        (absurd(planes=0), "no planes"),
        (absurd(row=0), "no pitch"),
        (absurd(bottom=0, top=5), "negative size"),
        (absurd(sv=0.0), "spacing"),
        (absurd(sh=float("nan")), "spacing"),
        (absurd(ov=float("inf")), "origin"),
        (absurd(gains=(1.0, 1.0, 0.0, 1.0)), "not in 0..64"),
        (absurd(gains=(1.0, float("nan"), 1.0, 1.0)), "not in 0..64"),
        (absurd(gains=(1.0, 1e30, 1.0, 1.0)), "not in 0..64"),
    ],
)
def test_a_gain_map_that_cannot_be_is_refused(make, body, words):
    with pytest.raises(ImageError, match=words):
        parse_opcodes(make.opcode_list(make.opcode(9, body)))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "0 bytes"),
        (struct.pack(">I", 1 << 31), "claims 2147483648 opcodes"),
        (struct.pack(">I", 1), "cut short"),
        (struct.pack(">5I", 1, 9, 0, 0, 1 << 31), "claims 2147483648 bytes"),
        (struct.pack(">5I", 1, 3, 0, 0, 8) + bytes(8), "8 bytes, not 56"),
        (struct.pack(">5I7d", 1, 3, 0, 0, 56, 0, 0, 0, 0, 0, 2, 0), "outside the picture"),
        (struct.pack(">5I7d", 1, 3, 0, 0, 56, -2, 0, 0, 0, 0, 0.5, 0.5), "not in 0..64"),
        (struct.pack(">5I7d", 1, 3, 0, 0, 56, 1e300, 1e300, 0, 0, 0, 0.5, 0.5), "not in 0..64"),
        (struct.pack(">5I7d", 1, 3, 0, 0, 56, float("nan"), 0, 0, 0, 0, 0.5, 0.5), "finite"),
    ],
)
def test_a_list_that_cannot_be_is_refused(data, words):
    with pytest.raises(ImageError, match=words):
        parse_opcodes(data)


@given(st.integers(0, 200), st.binary(max_size=160), st.integers(0, 15))
def test_garbage_is_refused_or_does_no_harm(count, body, code):
    data = struct.pack(">I", count) + struct.pack(">4I", code, 0, 0, len(body)) + body
    try:
        opcodes = parse_opcodes(data)
    except ImageError:
        return
    picture = np.ones((8, 8), np.float32)
    opcodes.apply(picture)
    assert (np.isfinite(picture) & (picture > 0)).all()
