"""Gloss and retro-reflection under a panorama against the integral over all of its directions."""

import numpy as np
import pytest
import torch

from relight.panorama import lat_long_directions, lat_long_solid_angles
from relight.prefiltering import GlossyEnvironment, even_light
from relight.reflectance import Reflectance

GLOSSY = Reflectance(retro=0.5, alpha=0.25, f0=0.04)


def by_sum(panorama, reflectance, normal, to_view, albedo):
    """Radiance [C] of a surface under a panorama, cell by cell, through `Reflectance.response`."""
    height, width = panorama.shape[:2]
    to_light = torch.from_numpy(lat_long_directions(height, width)).view(-1, 3)
    weight = torch.from_numpy(np.repeat(lat_long_solid_angles(height, width), width))[:, None]
    response = reflectance.response(torch.full((1, 3), albedo).double(), normal, to_light, to_view)
    return (response * weight * torch.from_numpy(panorama).double().view(-1, 3)).sum(dim=0) / np.pi


def unit(*vector):
    return torch.nn.functional.normalize(torch.tensor(vector, dtype=torch.float64), dim=0)


@pytest.mark.parametrize("view", [(0.0, 0.0, 1.0), (0.5, 0.2, 0.8), (0.9, 0.0, 0.3)])
def test_even_light_is_the_integral(view):
    to_view, normal = unit(*view), unit(0, 0, 1)
    even = np.ones((128, 256, 3), np.float32)
    diffuse, gloss = even_light(GLOSSY, to_view[2:])
    # Both are sums over some thousand directions; the lobe is twenty degrees wide.
    expected = by_sum(even, Reflectance(GLOSSY.retro), normal, to_view, 1.0)[0]
    assert diffuse.item() == pytest.approx(expected.item(), rel=0.01)
    expected = by_sum(even, GLOSSY, normal, to_view, 0.0)[0]
    assert gloss.item() == pytest.approx(expected.item(), rel=0.02)


def test_a_matte_surface_has_lambert_s_factor_and_no_gloss():
    diffuse, gloss = even_light(Reflectance(), torch.linspace(0, 1, 9))
    np.testing.assert_allclose(diffuse, 1.0, atol=1e-3)  # the middle of 64 rings of cosines
    np.testing.assert_array_equal(gloss, 0.0)


def test_an_even_panorama_stays_even():
    blurred = GlossyEnvironment.of_panorama(np.full((16, 32, 3), 0.7, np.float32), 0.25)
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    np.testing.assert_allclose(blurred(directions), 0.7, rtol=1e-4)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (-0.6, 0.5, 0.3)])
def test_a_patch_of_light_is_brightest_in_its_own_direction(axis):
    # Also across the seam of the panorama, which is at -Z.
    axis = unit(*axis)
    directions = lat_long_directions(64, 128)
    panorama = np.repeat(((directions @ axis.numpy()) > 0.98)[..., None], 3, axis=2).astype(np.float32)
    blurred = GlossyEnvironment.of_panorama(panorama, 0.25)
    around = torch.from_numpy(lat_long_directions(90, 180)).float().view(-1, 3)
    values = blurred(around)[:, 0]
    brightest = around[values > 0.98 * values.max()].mean(dim=0)
    assert torch.nn.functional.normalize(brightest, dim=0) @ axis.float() > np.cos(np.radians(3))


def test_gloss_seen_along_the_normal_is_the_integral():
    random = np.random.default_rng(0)
    panorama = np.repeat(np.repeat(random.uniform(0, 2, (8, 16, 3)), 8, 0), 8, 1).astype(np.float32)
    blurred = GlossyEnvironment.of_panorama(panorama, GLOSSY.alpha)
    for normal in (unit(0.3, 0.5, 0.8), unit(0, 1, 0), unit(-0.2, 0.1, -0.9)):
        _, gloss = even_light(GLOSSY, torch.ones(1, dtype=torch.float64))
        split = gloss * blurred(normal[None].float())[0].double()
        # Seen along the normal the lobe is exact but for masking and Fresnel, far from its middle.
        np.testing.assert_allclose(split, by_sum(panorama, GLOSSY, normal, normal, 0.0), rtol=0.05)


@pytest.mark.parametrize("tilt_deg", [30, 60])
def test_gloss_seen_at_an_angle_is_about_the_integral(tilt_deg):
    up = np.linspace(1, -1, 64)[:, None, None]
    panorama = np.broadcast_to(1.0 + 0.5 * up, (64, 128, 3)).astype(np.float32)  # a sky and a darker ground
    normal = unit(0, 0, 1)
    to_view = unit(0, np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg)))
    mirrored = 2 * (normal @ to_view) * normal - to_view
    blurred = GlossyEnvironment.of_panorama(panorama, GLOSSY.alpha)
    _, gloss = even_light(GLOSSY, to_view[2:])
    split = gloss * blurred(mirrored[None].float())[0].double()
    # The stretched lobe is not that of the normal view: the price of splitting the integral.
    np.testing.assert_allclose(split, by_sum(panorama, GLOSSY, normal, to_view, 0.0), rtol=0.1)
