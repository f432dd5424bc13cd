"""The losses of the face compare what is defined with what is known, by plain computations."""

import numpy as np
import torch

from relight.neural.losses.face import colour_loss, normal_loss, symmetry_loss
from relight.neural.losses.mismatch import Mismatch

RANDOM = np.random.default_rng(0)


def plain(first, second):
    """A Delta whose perceptual term is the mean square, in numpy."""
    blocks = (first - second).reshape(len(first), first.shape[1] // 4, 4, first.shape[2] // 4, 4)
    return ((first - second) ** 2).mean() + 2500.0 * np.abs(blocks.mean(axis=(2, 4))).mean()


MISMATCH = Mismatch(lambda a, b: ((a - b) ** 2).mean())


def test_symmetry_compares_with_the_half_and_its_mirror_image_where_the_albedo_is_defined():
    albedo, half = RANDOM.random((3, 16, 16)), RANDOM.random((3, 16, 8))
    defined = (RANDOM.random((16, 16)) > 0.3).astype(float)
    whole = np.zeros((3, 16, 16))
    for column in range(8):
        whole[:, :, column] = whole[:, :, 15 - column] = half[:, :, column]
    found = symmetry_loss(MISMATCH, *(torch.from_numpy(each) for each in (albedo, defined, half)))
    np.testing.assert_allclose(found, plain(albedo * defined, whole * defined), rtol=1e-12)


def test_symmetry_draws_the_half_texture_too():
    half = torch.full((3, 16, 8), 0.2, dtype=torch.float64, requires_grad=True)
    albedo = torch.full((3, 16, 16), 0.6, dtype=torch.float64)
    defined = torch.zeros(16, 16, dtype=torch.float64)
    defined[:, 12:] = 1.0  # the right half alone
    symmetry_loss(MISMATCH, albedo, defined, half).backward()
    assert bool((half.grad[..., :4] < 0).all())
    assert not half.grad[..., 4:].any()


def test_colour_is_the_mean_deviation_over_the_texels_that_are_known():
    albedo, colour = RANDOM.random((2, 3, 9, 9))
    defined = RANDOM.random((9, 9)) > 0.5
    expected = np.mean([np.abs(albedo[:, r, c] - colour[:, r, c]) for r, c in np.argwhere(defined)])
    found = colour_loss(*(torch.from_numpy(each) for each in (albedo, defined.astype(float), colour)))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_where_no_texel_is_known_there_is_no_loss_and_a_finite_gradient():
    albedo = torch.rand(3, 8, 8, requires_grad=True)
    nothing = torch.zeros(8, 8)
    loss = colour_loss(albedo, nothing, torch.rand(3, 8, 8)) + symmetry_loss(
        MISMATCH, albedo, nothing, torch.rand(3, 8, 4)
    )
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert not albedo.grad.any()


def test_normals_are_compared_on_the_face_alone():
    normals, known = RANDOM.normal(size=(2, 3, 8, 8))
    face = (RANDOM.random((1, 8, 8)) > 0.5).astype(float)
    found = normal_loss(MISMATCH, *(torch.from_numpy(each) for each in (normals, known, face)))
    np.testing.assert_allclose(found, plain(normals * face, known * face), rtol=1e-12)


def test_gradcheck():
    albedo = torch.rand(3, 8, 8, dtype=torch.float64, requires_grad=True)
    half = torch.rand(3, 8, 4, dtype=torch.float64, requires_grad=True)
    colour, defined = torch.rand(3, 8, 8, dtype=torch.float64), torch.ones(8, 8, dtype=torch.float64)
    face = torch.ones(1, 8, 8, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda a, t: symmetry_loss(MISMATCH, a, defined, t), (albedo, half))
    assert torch.autograd.gradcheck(lambda a: colour_loss(a, defined, colour), albedo)
    assert torch.autograd.gradcheck(lambda n: normal_loss(MISMATCH, n, colour, face), albedo)
