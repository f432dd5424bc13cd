"""Frames as targets: what is clipped, broken or beyond the edge is not known, whole and in patches."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from analytic_scene import looking_at, sphere_portrait

from relight.neural.crops import Crop
from relight.neural.frames import FrameStore
from relight.scene import Observation, View

SIZE = 32
VIEW = View(4, looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=SIZE, focal_px=60), 1)


@dataclass
class OneFrame:
    observation: Observation
    views = (VIEW,)

    def observe(self, view):
        assert view is VIEW
        return self.observation


def frame(**changes):
    radiance = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    parts = {"radiance": radiance, "valid": torch.ones(SIZE, SIZE), "mask": torch.ones(SIZE, SIZE)}
    return FrameStore(OneFrame(Observation(**(parts | changes))), sphere_portrait(2000)), radiance


def test_a_whole_frame_is_the_radiance_in_half_precision():
    store, radiance = frame()
    # Half floats have 11 bits.
    np.testing.assert_allclose(store.whole(VIEW).radiance, radiance.permute(2, 0, 1), rtol=2.0**-11)
    assert store.whole(VIEW).radiance.dtype == torch.float32


def test_a_pixel_that_is_clipped_makes_the_patchs_pixels_that_it_touches_unknown():
    valid = torch.ones(SIZE, SIZE)
    valid[10, 20] = 0.0
    store, _ = frame(valid=valid)
    whole = store.whole(VIEW)
    assert not whole.valid[0, 10, 20]
    assert not whole.radiance[:, 10, 20].any()
    small = store.patch(VIEW, Crop(0, 0, SIZE, SIZE // 4))
    assert not small.valid[0, 2, 5]
    assert float(small.valid.sum()) < small.valid.numel()
    assert not small.radiance[:, small.valid[0] == 0].any()
    np.testing.assert_array_equal(small.inside, 1.0)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e30])
def test_broken_pixels_are_unknown_and_0(bad):
    _, radiance = frame()
    broken = radiance.clone()
    broken[3, 4, 1] = bad
    store, _ = frame(radiance=broken)
    patch = store.patch(VIEW, Crop(0, 0, SIZE, SIZE))
    assert bool(patch.radiance.isfinite().all())
    assert not patch.valid[0, 3, 4]


def test_beyond_the_frame_nothing_is_known():
    store, _ = frame()
    patch = store.patch(VIEW, Crop(SIZE - 8, 0, 16, 16))
    np.testing.assert_array_equal(patch.inside[0, :, 8:], 0.0)
    np.testing.assert_array_equal(patch.inside[0, :, :8], 1.0)
    np.testing.assert_array_equal(patch.valid, patch.inside)


def test_a_frame_without_a_mask_takes_that_of_the_portrait():
    store, _ = frame(mask=None)
    mask = store.whole(VIEW).mask[0]
    # A sphere of 0.1 m half a metre away, seen with a focal length of 60 pixels: 12.2 pixels wide.
    assert mask[16, 16] == 1.0
    assert mask[0, 0] == 0.0
    assert abs(float(mask.sum()) - np.pi * 12.2**2) < 40
    np.testing.assert_array_equal(store.subject(VIEW), mask > 0.5)
