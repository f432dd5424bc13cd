"""All raw images in one lookup are those of one lookup a scale, and so are their gradients."""

import numpy as np
import torch
from analytic_scene import looking_at

from relight.neural.raw_images import raw_images
from relight.raster import gather_descriptors, rasterize_ids


def some_ids():
    random = np.random.default_rng(0)
    points = torch.from_numpy(random.uniform(-0.1, 0.1, size=(300, 3)).astype(np.float32))
    return rasterize_ids(points, looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=32), 3).ids


def test_they_are_those_of_one_scale_after_the_other():
    ids = some_ids()
    descriptors = torch.randn(300, 8, generator=torch.Generator().manual_seed(0))
    for image, level in zip(raw_images(descriptors, ids), ids, strict=True):
        np.testing.assert_array_equal(image[0], gather_descriptors(descriptors, level))


def test_gradients_reach_the_points_that_are_seen_and_no_others():
    ids = some_ids()
    grads = []
    for images in (raw_images, lambda d, levels: [gather_descriptors(d, level)[None] for level in levels]):
        descriptors = torch.ones(300, 8, requires_grad=True)
        weights = [torch.randn(8, *level.shape, generator=torch.Generator().manual_seed(1)) for level in ids]
        sum((image * w).sum() for image, w in zip(images(descriptors, ids), weights, strict=True)).backward()
        grads.append(descriptors.grad)
    # Sums of up to a thousand terms in float32.
    np.testing.assert_allclose(*grads, atol=1e-4)
    seen = torch.zeros(300, dtype=torch.bool)
    seen[torch.cat([level[level >= 0] for level in ids])] = True
    np.testing.assert_array_equal(grads[0].abs().sum(dim=1) > 0, seen)


def test_where_no_point_is_there_is_the_null_descriptor():
    empty = [torch.full((4, 6), -1), torch.full((2, 3), -1)]
    images = raw_images(torch.ones(1, 8), empty)
    assert [image.shape for image in images] == [(1, 8, 4, 6), (1, 8, 2, 3)]
    assert not any(image.any() for image in images)


def test_gradcheck():
    ids = [torch.tensor([[0, 2], [-1, 0]]), torch.tensor([[2]])]
    descriptors = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: tuple(raw_images(d, ids)), descriptors)
