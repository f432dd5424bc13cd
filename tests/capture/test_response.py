import numpy as np
import pytest

from capture.response import Response
from capture.transfer import to_linear


def test_a_named_response_is_its_transfer_function():
    codes = np.arange(256, dtype=np.uint8).reshape(-1, 1).repeat(3, 1)
    assert np.array_equal(Response("srgb").to_linear(codes), to_linear(codes, "srgb"))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_a_table_is_interpolated_for_every_type(kind):
    stored = np.linspace(0, 1, 33)
    table = Response(None, stored, np.stack([stored**2, stored**1.5, stored], axis=1))
    values = np.array([[0, 0, 0], [85, 85, 85], [255, 255, 255]]) / 255
    pixels = values.astype(kind) if kind is np.float32 else np.round(values * np.iinfo(kind).max).astype(kind)
    # linear interpolation of a second derivative of at most 2 over steps of 1/32: 2 / 8 / 32^2; sqrt near 0
    # is not met
    expected = values ** [2, 1.5, 1]
    assert np.abs(table.to_linear(pixels) - expected).max() < 2.5e-4


def test_one_column_is_for_all_channels():
    table = Response(None, np.array([0.0, 1.0]), np.array([0.0, 0.5]))
    assert table.to_linear(np.full((1, 3), 255, np.uint8)).tolist() == [[0.5] * 3]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((None,), "transfer name"),
        (("srgb", np.arange(2.0), np.arange(2.0)), "transfer name"),
        ((None, np.array([0.0]), np.array([0.0])), "two or more"),
        ((None, np.array([0.0, 1.0]), np.zeros((2, 2))), "two or more"),
        ((None, np.array([0.0, 0.0]), np.array([0.0, 1.0])), "must rise"),
        ((None, np.array([0.0, 2.0]), np.array([0.0, 1.0])), "must rise"),
        ((None, np.array([0.0, 1.0]), np.array([1.0, 0.0])), "must not fall"),
        (("film",), "film"),
    ],
)
def test_an_impossible_response_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        Response(*arguments)
