"""Tangent frames are orthonormal and right-handed for every unit normal, the poles too."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relight.tangents import tangents

coordinate = st.floats(-1, 1, width=32)


@given(st.tuples(coordinate, coordinate, coordinate).filter(lambda v: np.linalg.norm(v) > 1e-3))
@pytest.mark.filterwarnings("error")
def test_frames_are_orthonormal_and_right_handed(vector):
    normal = (np.asarray(vector) / np.linalg.norm(vector)).astype(np.float32)
    first, second = (axis[0] for axis in tangents(normal[None]))
    # The normal is unit to 1e-7; near the pole z = -0 the formula multiplies its rounding by about two.
    np.testing.assert_allclose(
        np.stack([first, second, normal]) @ np.stack([first, second, normal]).T, np.eye(3), atol=1e-5
    )
    np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-5)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_poles_have_frames(z):
    first, second = tangents(np.array([[0.0, -0.0, z]], np.float32))
    np.testing.assert_array_equal(np.cross(first, second), [[0, 0, z]])
