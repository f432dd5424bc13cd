"""Panoramas and their irradiance against the plain sum over all pixels."""

import logging
import math

import cv2
import numpy as np
import pytest
import torch

from capture.images import write_exr
from relight.environment import DiffuseIrradiance, cluster_lights, flux_tiles
from relight.errors import LightError
from relight.panorama import (
    lat_long_directions,
    lat_long_solid_angles,
    lat_long_vectors,
    panorama_to_sh,
    read_panorama,
)
from relight.spherical_harmonics import sh_irradiance


def random_normals(count=1500, seed=0):
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def plain_irradiance(panorama, normals):
    """Sum over the pixels of radiance * solid angle * clamped cosine."""
    height, width, channels = panorama.shape
    directions = lat_long_directions(height, width).reshape(-1, 3)
    flux = (panorama * lat_long_solid_angles(height, width)[:, None, None]).reshape(-1, channels)
    return np.maximum(normals @ directions.T, 0.0) @ flux


def uniform():
    return np.ones((64, 128, 3), np.float32)


def lone_sun():
    panorama = np.zeros((64, 128, 3), np.float32)
    panorama[20, 77] = (1e4, 8e3, 5e3)
    return panorama


def window_and_sky():
    panorama = np.full((128, 256, 3), 0.1, np.float32)
    panorama[:50] += (0.1, 0.2, 0.4)
    panorama[40:44, 150:157] = 300.0
    return panorama


def spikes():
    """Radiance over ten decades without any order."""
    return (np.random.default_rng(3).exponential(size=(96, 192, 3)) ** 6).astype(np.float32)


PANORAMAS = [uniform, lone_sun, window_and_sky, spikes]


def test_directions_follow_the_lat_long_convention():
    directions = lat_long_directions(128, 256)
    # The half pixel between a cell's centre and the axis is pi / 256 = 0.0123 rad.
    np.testing.assert_allclose(directions[0].mean(axis=0), (0, 1, 0), atol=1e-3)
    np.testing.assert_allclose(directions[63:65, 127:129].mean(axis=(0, 1)), (0, 0, 1), atol=1e-3)
    np.testing.assert_allclose(directions[63:65, 63:65].mean(axis=(0, 1)), (1, 0, 0), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-12)


def test_solid_angles_and_vectors_are_exact_integrals():
    height, width = 16, 32
    assert lat_long_solid_angles(height, width).sum() * width == pytest.approx(4 * math.pi, rel=1e-12)
    fine = 64  # the midpoint rule on cells split 64 x 64 is off by (pi / 1024)^2 / 24 = 4e-7, relative
    directions = lat_long_directions(height * fine, width * fine)
    weighted = directions * lat_long_solid_angles(height * fine, width * fine)[:, None, None]
    summed = weighted.reshape(height, fine, width, fine, 3).sum(axis=(1, 3))
    np.testing.assert_allclose(lat_long_vectors(height, width), summed, atol=1e-7)


@pytest.mark.parametrize("shape", [(4, 8), (64, 128), (100, 200), (150, 300)])
def test_tiles_keep_all_flux(shape):
    panorama = np.random.default_rng(0).uniform(size=(*shape, 2))
    flux = flux_tiles(panorama)
    assert flux.shape == (64, 128, 2, 3)
    expected = np.einsum("hwc,hwx->cx", panorama, lat_long_vectors(*shape))
    np.testing.assert_allclose(flux.sum(axis=(0, 1)), expected, atol=1e-12)  # rounding of double precision


@pytest.mark.parametrize("make", PANORAMAS)
def test_irradiance_is_the_plain_sum(make):
    panorama = make()
    normals = random_normals()
    irradiance = DiffuseIrradiance.of_panorama(panorama)(torch.from_numpy(normals)).numpy()
    expected = plain_irradiance(panorama, normals)
    error = np.abs(irradiance - expected)
    # Over the kink where a lone light sets, bilinear interpolation errs by a quarter of the table's step, up
    # to 2.2 degrees along a diagonal, 1 % of the peak. Elsewhere only curvature remains, (2.2 degrees)^2 / 8.
    assert error.max() < 0.01 * expected.max()
    assert error.mean() < 0.0005 * expected.mean()


def test_uniform_environment_gives_pi_for_every_normal():
    irradiance = DiffuseIrradiance.of_panorama(uniform())(torch.from_numpy(random_normals(200)))
    # Tiles are flat: their cosine is right to (2.8 degrees)^2 / 12, and the table to (1.4 degrees)^2 / 8.
    np.testing.assert_allclose(irradiance.numpy(), math.pi, rtol=5e-4)


def test_irradiance_is_continuous_across_the_seam_of_its_table():
    irradiance = DiffuseIrradiance.of_panorama(spikes())
    angle = torch.linspace(0, 2 * math.pi, 100, dtype=torch.float64)
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    tilt = torch.tensor([0.0, 0.0, 1e-9], dtype=torch.float64)
    # A tilt of 1e-9 changes E by at most its largest slope, which is about its size.
    torch.testing.assert_close(irradiance(ring + tilt), irradiance(ring - tilt), rtol=1e-6, atol=0)


def test_irradiance_scales_with_the_normal_and_is_zero_without_one():
    irradiance = DiffuseIrradiance.of_panorama(window_and_sky())
    normals = torch.from_numpy(random_normals(10))
    torch.testing.assert_close(irradiance(0.5 * normals), 0.5 * irradiance(normals))
    assert torch.equal(irradiance(torch.zeros(2, 5, 3)), torch.zeros(2, 5, 3))


def test_irradiance_has_correct_and_finite_gradients():
    irradiance = DiffuseIrradiance.of_panorama(window_and_sky())
    normals = torch.from_numpy(random_normals(20)).requires_grad_()
    assert torch.autograd.gradcheck(irradiance, normals)
    singular = torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, -1]], requires_grad=True)
    irradiance(singular).sum().backward()
    assert singular.grad is not None
    assert torch.isfinite(singular.grad).all()


def test_three_bands_come_near_the_integral_in_a_smooth_environment():
    panorama = (1.0 + 0.5 * lat_long_directions(64, 128)).astype(np.float32)
    normals = random_normals(100)
    irradiance = sh_irradiance(panorama_to_sh(panorama), torch.from_numpy(normals)).numpy()
    # The radiance has two bands only; what is left is the midpoint rule's (pi / 64)^2 / 24 and float32 input.
    np.testing.assert_allclose(irradiance, plain_irradiance(panorama, normals), rtol=5e-4)


def test_projection_in_pieces_is_the_projection_of_the_whole():
    small = np.random.default_rng(0).uniform(size=(32, 64, 3))
    large = small.repeat(16, axis=0).repeat(16, axis=1)  # 512 x 1024, read in pieces
    # The same function; the midpoint rule on the small one is off by (3 pi / 32)^2 / 24, three bands.
    torch.testing.assert_close(panorama_to_sh(large), panorama_to_sh(small), rtol=0, atol=0.004)


@pytest.mark.parametrize("make", PANORAMAS)
def test_128_lights_stand_for_a_panorama_to_a_percent(make):
    panorama = make()
    normals = random_normals()
    directions, irradiances = cluster_lights(panorama, 128)
    assert len(directions) <= 128
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(len(directions), dtype=torch.float64))
    expected = plain_irradiance(panorama, normals)
    error = np.abs(np.maximum(normals @ directions.numpy().T, 0.0) @ irradiances.numpy() - expected)
    assert error.mean() < 0.01 * expected.mean()


def test_a_lone_sun_is_one_light_and_a_black_panorama_none():
    directions, irradiances = cluster_lights(lone_sun(), 64)
    assert len(directions) == 1
    sun = lat_long_directions(64, 128)[20, 77]
    # The mean direction over a cell of 2.8 degrees and its centre differ by (2.8 degrees)^2 / 24.
    np.testing.assert_allclose(directions[0].numpy(), sun, atol=2e-4)
    np.testing.assert_allclose(
        irradiances[0], lone_sun()[20, 77] * lat_long_solid_angles(64, 128)[20], rtol=1e-3
    )
    directions, irradiances = cluster_lights(np.zeros((8, 16, 3)), 64)
    assert torch.isfinite(directions).all()
    assert irradiances.sum() == 0


def test_at_least_one_light_is_wanted():
    with pytest.raises(ValueError, match="at least one light"):
        cluster_lights(uniform(), 0)


def test_exr_and_hdr_panoramas_are_read_as_linear_rgb(tmp_path):
    panorama = np.random.default_rng(0).uniform(0.1, 4.0, size=(8, 16, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", panorama, half=False)
    np.testing.assert_array_equal(read_panorama(tmp_path / "a.exr"), panorama)
    assert cv2.imwrite(str(tmp_path / "a.hdr"), panorama[..., ::-1])
    # Radiance RGBE shares an exponent: 8 bits of the largest channel, half a step of 1 / 128 of at most 4.
    np.testing.assert_allclose(read_panorama(tmp_path / "a.hdr"), panorama, atol=4.0 / 128)


def test_grey_negative_and_infinite_values_are_read(tmp_path, caplog):
    grey = np.full((2, 4), 0.5, np.float32)
    grey[0, 0], grey[0, 1], grey[1, 1] = -1.0, np.inf, 3.0
    write_exr(tmp_path / "grey.exr", grey, half=False)
    with caplog.at_level(logging.WARNING):
        panorama = read_panorama(tmp_path / "grey.exr")
    assert panorama.shape == (2, 4, 3)
    assert panorama[0, 0, 0] == 0.0
    assert panorama[0, 1, 2] == 3.0
    assert "infinite" in caplog.text


def test_unusable_panoramas_say_why(tmp_path):
    with pytest.raises(LightError, match=r"missing\.exr"):
        read_panorama(tmp_path / "missing.exr")
    with pytest.raises(LightError, match=r"\.hdr or \.exr"):
        read_panorama(tmp_path / "photo.jpg")
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3)))
    with pytest.raises(LightError, match="8 x 8 pixels"):
        read_panorama(tmp_path / "square.exr")
    write_exr(tmp_path / "nan.exr", np.full((4, 8, 3), np.nan))
    with pytest.raises(LightError, match="96 values that are not numbers"):
        read_panorama(tmp_path / "nan.exr")
    (tmp_path / "garbage.hdr").write_bytes(b"#?RADIANCE\n garbage")
    with pytest.raises(LightError, match=r"garbage\.hdr"):
        read_panorama(tmp_path / "garbage.hdr")
