import numpy as np
import pytest

from capture.errors import TaggingError
from capture.tagging import ProfileAccumulator
from capture.transfer import to_display


def filled(value, shape=(90, 160)):
    return np.full(shape, value, np.uint8)


def test_rows_of_the_frame_stay_rows_of_the_profile():
    accumulator = ProfileAccumulator(320, 192, transfer="srgb")
    frame = filled(20, (192, 320))
    frame[96:] = 220
    accumulator.add(frame, 0.0)
    codes = accumulator.profiles().codes[0]
    half = len(codes) // 2
    assert (codes[:half] == 20).all()
    assert (codes[half:] == 220).all()


def test_limited_range_luma_is_scaled_to_black_and_white():
    accumulator = ProfileAccumulator(160, 90, transfer="srgb", levels=(16, 235))
    accumulator.add(filled(16), 0.0)
    accumulator.add(filled(235), 1.0)
    codes = accumulator.profiles().codes
    assert (codes[0] == 0).all()
    assert (codes[1] == 255).all()


@pytest.mark.parametrize("transfer", ["srgb", "rec709", "gamma:2.2", "linear"])
def test_profiles_are_linear_light_whatever_the_transfer(transfer):
    for radiance in (0.02, 0.2, 0.8):
        accumulator = ProfileAccumulator(160, 90, transfer=transfer)
        stored = np.rint(255 * to_display(np.float32(radiance), transfer)).astype(np.uint8)
        accumulator.add(filled(stored), 0.0)
        # Two roundings to 8 bit: each half a code, whose share of the light is largest in the shadows.
        assert accumulator.profiles().linear(0).mean() == pytest.approx(radiance, rel=0.05, abs=0.003)


def test_colour_and_grey_frames_give_the_same_luma():
    grey, colour = (ProfileAccumulator(160, 90, transfer="srgb") for _ in range(2))
    grey.add(filled(90), 0.0)
    colour.add(filled(90, (90, 160, 3)), 0.0)
    np.testing.assert_array_equal(grey.profiles().codes, colour.profiles().codes)
    assert grey.profiles().color is None
    assert colour.profiles().color is not None


def test_unreadable_frames_are_kept_and_marked():
    accumulator = ProfileAccumulator(160, 90, transfer="srgb")
    accumulator.add(np.full((90, 160), np.nan, np.float32), 0.0)
    accumulator.add(np.full((90, 160), 0.5, np.float32), 0.1)
    profiles = accumulator.profiles()
    assert profiles.readable.tolist() == [False, True]
    assert np.isfinite(profiles.linear(0)).all()


def test_frames_of_another_size_or_out_of_order_are_refused():
    accumulator = ProfileAccumulator(160, 90, transfer="srgb")
    accumulator.add(filled(10), 1.0)
    with pytest.raises(TaggingError, match="one size"):
        accumulator.add(filled(10, (90, 162)), 1.1)
    for pts_s in (1.0, 0.5, float("nan")):
        with pytest.raises(TaggingError, match="sort the frames"):
            accumulator.add(filled(10), pts_s)
    with pytest.raises(TaggingError, match="too small"):
        ProfileAccumulator(8, 8, transfer="srgb")


def test_memory_a_frame_does_not_grow_with_the_picture():
    sizes = []
    for scale in (1, 4):
        accumulator = ProfileAccumulator(320 * scale, 180 * scale, transfer="srgb")
        accumulator.add(filled(50, (180 * scale, 320 * scale)), 0.0)
        sizes.append(accumulator.profiles().codes.nbytes)
    assert sizes[0] == sizes[1] < 20_000
