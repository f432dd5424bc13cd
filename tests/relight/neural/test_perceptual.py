"""Both perceptual terms by plain computations, and what they do with equal, constant and black pictures."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d, zoom

from relight.neural.perceptual import VggPerceptual, laplacian_perceptual
from relight.neural.vgg import Vgg16

RANDOM = np.random.default_rng(0)
TAPS = np.array([1, 4, 6, 4, 1]) / 16


def blurred(image):
    """[C, H, W], edges repeated."""
    return correlate1d(correlate1d(image, TAPS, axis=1, mode="nearest"), TAPS, axis=2, mode="nearest")


def doubled(image):
    """Bilinear at twice the size, centres at 0.5."""
    return np.stack([zoom(c, 2, order=1, mode="nearest", grid_mode=True) for c in image])


def similarity(first, second):
    """Contrast and structure of two bands' luminance, window after window."""
    grey = [np.tensordot([0.2126, 0.7152, 0.0722], each, 1) for each in (first, second)]
    found = []
    for row in range(0, grey[0].shape[0] - 7, 4):
        for column in range(0, grey[0].shape[1] - 7, 4):
            a, b = (each[row : row + 8, column : column + 8] for each in grey)
            found.append((2 * (a * b).mean() + 0.0009) / ((a * a).mean() + (b * b).mean() + 0.0009))
    return np.mean(found)


def plain_laplacian(first, second):
    """The weight-free mismatch of pictures [3, 32, 32] in numpy, of five scales, structure at three."""
    detail, structure = [], []
    for scale in range(5):
        small = [blurred(each)[:, ::2, ::2] for each in (first, second)]
        bands = [each - doubled(low) for each, low in zip((first, second), small, strict=True)]
        detail.append((np.abs(bands[0] - bands[1]) / (blurred(np.abs(bands[1])) + 0.05)).mean())
        if scale < 3:
            structure.append(1 - similarity(*bands))
        first, second = small
    return np.mean(detail) + np.mean(structure)


def pair(size=32):
    """Two unlike pictures [1, 3, size, size], float64."""
    return (torch.from_numpy(each) for each in RANDOM.random((2, 1, 3, size, size)))


def test_the_weight_free_term_is_the_plain_sum_of_bands_and_structure():
    first, second = pair()
    ratio = float(laplacian_perceptual(first, second)) / plain_laplacian(first[0].numpy(), second[0].numpy())
    other = [0.2 * each + 0.4 for each in (first, second)]
    again = float(laplacian_perceptual(*other)) / plain_laplacian(*(each[0].numpy() for each in other))
    # One constant factor, the same for all pictures; float64 on both sides.
    np.testing.assert_allclose(again, ratio, rtol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_equal_and_constant_pictures_cost_nothing_and_have_finite_gradients(value):
    picture = torch.full((1, 3, 32, 32), value, requires_grad=True)
    loss = laplacian_perceptual(picture, picture.detach().clone())
    loss.backward()
    assert abs(float(loss.detach())) < 1e-4
    assert bool(picture.grad.isfinite().all())
    against = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    for first, second in ((picture, against), (against, picture)):
        picture.grad = None
        loss = laplacian_perceptual(first, second)
        loss.backward()
        assert float(loss.detach()) > 1
        assert bool(picture.grad.isfinite().all())


@pytest.mark.parametrize("size", [1, 2, 3, 5, 31])
def test_pictures_of_any_size_are_compared(size):
    first, second = torch.rand(2, 1, 3, size, size, generator=torch.Generator().manual_seed(0))
    assert bool(laplacian_perceptual(first, second).isfinite())


def test_blur_noise_and_a_shift_cost_more_the_stronger_they_are():
    sharp = torch.from_numpy(blurred(RANDOM.random((3, 64, 64))))[None]
    noise = torch.from_numpy(RANDOM.normal(size=(1, 3, 64, 64)))
    soft = torch.from_numpy(blurred(sharp[0].numpy()))[None]
    softer = torch.from_numpy(blurred(blurred(soft[0].numpy())))[None]
    costs = [float(laplacian_perceptual(each, sharp)) for each in (sharp, soft, softer)]
    assert costs == sorted(costs)
    costs = [float(laplacian_perceptual(sharp + sigma * noise, sharp)) for sigma in (0.0, 0.02, 0.1)]
    assert costs == sorted(costs)
    costs = [float(laplacian_perceptual(sharp.roll(shift, -1), sharp)) for shift in (0, 1, 2)]
    assert costs == sorted(costs)


def test_the_gradient_of_the_picture_is_that_of_finite_differences():
    first, second = pair(8)
    assert torch.autograd.gradcheck(lambda a: laplacian_perceptual(a, second), first.requires_grad_(True))


def test_the_term_of_vgg_is_the_plain_l1_of_its_features():
    torch.manual_seed(0)
    network = Vgg16(["relu1_1", "relu1_2"]).double().requires_grad_(False)
    first, second = pair(6)
    mean, spread = (np.array(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    features = []
    for picture in (first, second):
        x, found = (picture[0].numpy() - mean) / spread, []
        for layer in (network.features[0], network.features[2]):
            padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
            windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
            x = np.einsum("chwij,ocij->ohw", windows, layer.weight.numpy())
            x = np.maximum(x + layer.bias.numpy()[:, None, None], 0)
            found.append(x)
        features.append(found)
    expected = sum(np.abs(a - b).mean() for a, b in zip(*features, strict=True))
    found = VggPerceptual(network).double()(first, second)
    # Features are compared in float32.
    np.testing.assert_allclose(found, 255 * 0.226 * expected, rtol=1e-6)


def test_equal_pictures_cost_nothing_in_vgg_and_gradients_reach_both():
    torch.manual_seed(0)
    term = VggPerceptual(Vgg16(["relu2_2"]).requires_grad_(False))
    first, second = (each.float().requires_grad_(True) for each in pair(8))
    assert float(term(first, first).detach()) == 0.0
    term(first, second).backward()
    for picture in (first, second):
        assert bool(picture.grad.any())
        assert bool(picture.grad.isfinite().all())
