"""Textures: bilinear samples with gradients, halves that mirror each other, robust medians."""

import numpy as np
import pytest
import torch

from relight.face.textures import PositionMap, half_texture, median_texture, sample_texture, whole_texture


def grid_map(scale=0.25, offset=(3.0, 5.0), cosine=1.0):
    """Texel (i, j) at the pixel offset + scale (j, i)."""
    i, j = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    uv_px = torch.stack([offset[0] + scale * j, offset[1] + scale * i], dim=-1)
    return PositionMap(uv_px, torch.full((256, 256), cosine))


def test_a_linear_picture_is_sampled_exactly():
    v, u = torch.meshgrid(torch.arange(80.0) + 0.5, torch.arange(90.0) + 0.5, indexing="ij")
    position_map = grid_map()
    texture, defined = sample_texture(torch.stack([u, v]), position_map)
    # float32 of numbers up to 70.
    torch.testing.assert_close(texture.permute(1, 2, 0), position_map.uv_px, rtol=0, atol=2e-4)
    assert bool((defined == 1).all())


def test_outside_and_at_grazing_angles_the_texture_is_not_defined():
    position_map = grid_map(scale=1.0)
    texture, defined = sample_texture(torch.ones(1, 100, 120), position_map)
    assert defined.sum() == (100 - 5 + 1) * (120 - 3 + 1)
    assert not texture[0][defined == 0].any()
    _, grazing = sample_texture(torch.ones(1, 300, 300), grid_map(cosine=0.1))
    assert not grazing.any()


def test_hidden_texels_at_infinity_give_finite_values_and_gradients():
    position_map = grid_map()
    position_map.uv_px[:10] = torch.nan
    image = torch.rand(3, 80, 90, generator=torch.Generator().manual_seed(0), requires_grad=True)
    texture, defined = sample_texture(image, position_map)
    assert not defined[:10].any()
    texture.square().sum().backward()
    assert texture.isfinite().all()
    assert image.grad.isfinite().all()


def test_gradients_of_the_picture_and_of_the_half_texture_are_right():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 6, 7, dtype=torch.float64, generator=generator, requires_grad=True)
    i, j = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    uv_px = torch.stack([0.7 + 0.6 * j, 0.9 + 0.5 * i], dim=-1).double()
    half = torch.rand(2, 8, 4, dtype=torch.float64, generator=generator, requires_grad=True)

    def loss(image, half):
        texture, defined = sample_texture(image, PositionMap(uv_px, torch.ones(8, 8)))
        return ((texture - whole_texture(half)) * defined).square().sum()

    assert torch.autograd.gradcheck(loss, (image, half))


def test_a_half_texture_is_whole_again_and_mirrors():
    half = torch.rand(3, 256, 128, generator=torch.Generator().manual_seed(0))
    whole = whole_texture(half)
    assert whole.shape == (3, 256, 256)
    torch.testing.assert_close(whole, whole.flip(-1))
    again, weight = half_texture(whole, torch.ones(256, 256))
    torch.testing.assert_close(again, half)
    assert (weight == 2).all()


def test_where_one_side_is_unknown_the_other_counts_alone():
    texture = torch.zeros(1, 256, 256)
    texture[..., :128], texture[..., 128:] = 3.0, 5.0
    defined = torch.ones(256, 256)
    defined[:100, :128] = 0.0
    defined[50:60] = 0.0
    half, weight = half_texture(texture, defined)
    assert (half[0, :50] == 5.0).all()
    assert (half[0, 100:] == 4.0).all()
    assert (half[0, 50:60] == 0.0).all()
    assert (weight[50:60] == 0).all()


def test_the_median_passes_over_highlights_and_what_is_hidden():
    textures = [torch.full((3, 256, 256), value) for value in (0.4, 0.5, 0.6, 9.0, 0.5)]
    defined = [torch.ones(256, 256) for _ in textures]
    for each in defined:
        each[:3] = 0.0
    median, count = median_texture(textures, defined)
    assert (median[:, 3:] == 0.5).all()
    assert not median[:, :3].any()
    assert count.unique().tolist() == [0.0, 5.0]


def test_a_median_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        median_texture([], [])


def test_the_median_is_between_the_values_of_its_texel():
    generator = torch.Generator().manual_seed(1)
    textures = [torch.rand(1, 256, 256, generator=generator) for _ in range(4)]
    defined = [(torch.rand(256, 256, generator=generator) > 0.3).float() for _ in range(4)]
    median, count = median_texture(textures, defined)
    stack = np.where(torch.stack(defined)[:, None] > 0, torch.stack(textures), np.nan)
    known = count.numpy() > 0
    low, high = np.nanmin(stack[:, 0][:, known], axis=0), np.nanmax(stack[:, 0][:, known], axis=0)
    assert ((median[0].numpy()[known] >= low) & (median[0].numpy()[known] <= high)).all()
