import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.tagging.shutter import lit_share, sharp_limits

# Rows of the brute force: fine enough that a band's mean is known to 1e-3 of an exposure.
ROWS, BANDS = 2000, 20


def brute_force(start_s, on_s, off_s, readout_s, exposure_s):
    """Overlap of each row's exposure with the pulse, row by row, averaged over bands."""
    first = start_s + (np.arange(ROWS) + 0.5) / ROWS * readout_s + max(0.0, -readout_s)
    overlap = np.minimum(first + exposure_s, off_s) - np.maximum(first, on_s)
    return np.clip(overlap / exposure_s, 0.0, 1.0).reshape(BANDS, -1).mean(axis=1)


@given(
    on_s=st.floats(-0.05, 0.05),
    length_s=st.floats(0.0, 0.15),
    readout_s=st.sampled_from([-0.02, 0.0, 0.01, 0.02, 0.033]),
    exposure_s=st.sampled_from([0.0005, 0.005, 0.02]),
)
def test_lit_share_is_the_overlap_of_exposure_and_pulse(on_s, length_s, readout_s, exposure_s):
    share = lit_share(0.0, on_s, on_s + length_s, readout_s, exposure_s, BANDS)
    # A band has 100 rows; at an edge one row's step is 1/100 of a band where the exposure is short.
    np.testing.assert_allclose(
        share, brute_force(0.0, on_s, on_s + length_s, readout_s, exposure_s), atol=0.011
    )


@given(shift_s=st.floats(-100.0, 100.0))
def test_only_the_difference_of_times_matters(shift_s):
    plain = lit_share(0.0, 0.004, 0.1, 0.02, 0.005, BANDS)
    # Times near 100 s have a spacing of 1.4e-14 s: 3e-12 of an exposure, summed over few operations.
    np.testing.assert_allclose(
        lit_share(shift_s, 0.004 + shift_s, 0.1 + shift_s, 0.02, 0.005, BANDS), plain, atol=1e-8
    )


@pytest.mark.parametrize("readout_s", [0.01, -0.02, 0.033])
def test_sharp_limits_are_where_the_worst_row_crosses_the_label(readout_s):
    on_full, off_full, off_none, on_none = sharp_limits(readout_s, 0.005, 0.98, 0.02)
    bands = 1000  # so narrow that a band is as good as a row

    def worst(on_s, off_s):
        share = lit_share(0.0, on_s, off_s, readout_s, 0.005, bands)
        return share.min(), share.max()

    # A band is 1/1000 of a readout wide: up to 0.7 % of the exposure here.
    assert worst(on_full, 1.0)[0] == pytest.approx(0.98, abs=0.007)
    assert worst(-1.0, off_full)[0] == pytest.approx(0.98, abs=0.007)
    assert worst(-1.0, off_none)[1] == pytest.approx(0.02, abs=0.007)
    assert worst(on_none, 1.0)[1] == pytest.approx(0.02, abs=0.007)
