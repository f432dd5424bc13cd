import numpy as np
import pytest

from capture.errors import RelightError, TransferError
from capture.transfer import OPEN_CAMERA_PROFILES, canonical_transfer, to_display, to_linear

NAMES = [
    *("linear", "srgb", "rec709", "gamma:1.6", "gamma:2.8", "gamma:2.2@64"),
    *("log:10", "log:500", "log:100@64", "log:500@32", "jtvideo", "jtlog", "jtlog2"),
]


@pytest.mark.parametrize("name", NAMES)
def test_decoding_undoes_encoding_everywhere(name):
    linear = np.linspace(0.0, 1.0, 4097)
    # Encoded values are float32 (2^-24 relative); the flattest curve, jtlog's end, has slope 4 / 13, and the
    # steepest decoding slope is that of log:500 at white, about 6.
    assert np.abs(to_linear(to_display(linear, name), name) - linear).max() < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_every_code_comes_back_from_radiance(name):
    codes = np.arange(256, dtype=np.uint8)
    assert np.array_equal(np.round(to_display(to_linear(codes, name), name) * 255).astype(np.uint8), codes)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_radiance_rises_with_the_code_from_black_to_white(name, kind):
    largest = np.iinfo(kind).max
    radiance = to_linear(np.arange(largest + 1, dtype=kind), name)
    assert radiance.dtype == np.float32
    assert radiance[0] == 0.0
    assert radiance[-1] == pytest.approx(1.0, abs=1e-7)  # float32
    # strictly for 8 bits; 16-bit steps near black of a strong curve may fall below float32's resolution
    assert (np.diff(radiance) > 0 if kind is np.uint8 else np.diff(radiance) >= 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_integers_and_floats_agree(name):
    codes = np.arange(65536, dtype=np.uint16)
    as_floats = to_linear((codes / 65535).astype(np.float32), name)
    assert np.abs(to_linear(codes, name) - as_floats).max() < 2e-6  # float32 input, slope up to 13


@pytest.mark.parametrize(
    ("name", "stored", "linear"),
    [
        ("srgb", 0.04045, 0.0031308),  # IEC 61966-2-1: the knee
        ("srgb", 0.5, 0.21404114),
        ("rec709", 0.081, 0.018),  # BT.709: the knee
        ("rec709", 0.409, 0.18),  # BT.709: mid grey
        ("gamma:2.2", 0.5, 0.21763764),
        ("log:100", 0.5, (np.sqrt(101) - 1) / 100),
        ("jtvideo", 0.31, 0.09),
        ("jtlog", 0.17, 0.03),
        ("jtlog2", 0.98, 0.99),
    ],
)
def test_known_points_of_the_curves(name, stored, linear):
    # 2e-4: the standards print their constants to three or four digits
    assert to_linear(np.array([stored]), name)[0] == pytest.approx(linear, rel=2e-3, abs=2e-6)


def test_control_points_make_the_curve_piecewise_linear():
    # In the middle of the first of 63 intervals the sampled curve has half of its end; the smooth one much
    # more.
    first = np.log1p(500 / 63) / np.log1p(500)
    assert to_display(np.array([0.5 / 63]), "log:500@64")[0] == pytest.approx(first / 2, rel=1e-6)
    assert to_display(np.array([0.5 / 63]), "log:500")[0] > 0.7 * first


@pytest.mark.parametrize("name", ["linear", "srgb", "rec709", "gamma:2.2"])
def test_values_beyond_white_are_kept_and_negative_ones_are_not(name):
    radiance = to_linear(np.array([-0.5, 1.0, 1.5], np.float32), name)
    assert radiance[0] == 0.0
    assert radiance[2] > radiance[1]
    assert to_display(np.array([-1.0, 7.0]), name).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("sRGB (IEC 61966-2-1)", "srgb"),
        ("SRGB", "srgb"),
        ("BT.709", "rec709"),
        ("Rec.709", "rec709"),
        ("Linear", "linear"),
        ("GAMMA:2.20", "gamma:2.2"),
        ("log:100@064", "log:100@64"),
    ],
)
def test_common_spellings_are_one_name(spelling, name):
    assert canonical_transfer(spelling) == name


def test_open_camera_profiles_are_known_names():
    assert all(canonical_transfer(name) == name for name in OPEN_CAMERA_PROFILES.values())


@pytest.mark.parametrize(
    "name", ["", "slog3", "gamma", "gamma:0", "gamma:nan", "log:-1", "gamma:2@1", "log:1e9", None]
)
def test_an_unknown_name_is_one_sentence(name):
    with pytest.raises(TransferError) as caught:
        to_linear(np.zeros(3, np.uint8), name)
    assert isinstance(caught.value, RelightError)
    assert isinstance(caught.value, ValueError)
    assert str(caught.value).count(".") >= 1


def test_signed_integers_are_refused():
    with pytest.raises(TransferError, match="int64"):
        to_linear(np.zeros(3, np.int64), "srgb")
