"""Display values are sRGB inside 0..1, and go on with a gradient beyond."""

import numpy as np
import torch

from capture.transfer import to_display
from relight.neural.display import display_values


def test_inside_they_are_the_srgb_of_the_capture():
    linear = np.linspace(0, 1, 1001)
    # Both in float64; the curve's two parts meet within 1e-8 of each other by its standard.
    np.testing.assert_allclose(display_values(torch.from_numpy(linear)), to_display(linear), atol=1e-7)


def test_beyond_both_ends_they_rise():
    linear = torch.tensor(
        [-1e3, -1.0, 0.0, 0.0031308, 1.0, 10.0, 1e6], dtype=torch.float64, requires_grad=True
    )
    values = display_values(linear)
    values.sum().backward()
    assert bool((values.diff() > 0).all())
    assert bool((linear.grad > 0).all())
    assert float(linear.grad.max()) <= 12.93


def test_gradcheck():
    linear = torch.tensor([-0.5, 0.001, 0.1, 0.9, 1.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(display_values, linear)
