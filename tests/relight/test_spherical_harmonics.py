"""Spherical harmonics against scipy's functions, the published constants and plain numerical integration."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from relight.spherical_harmonics import (
    cosine_convolution,
    irradiance_matrix,
    project_to_sh,
    quadratic_irradiance,
    rotate_sh,
    rotation_about_up,
    sh_basis,
    sh_irradiance,
)

DOUBLE = torch.float64


def random_directions(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=DOUBLE), dim=-1)


def random_coefficients(bands, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(bands * bands, 3, generator=generator, dtype=DOUBLE)


def sphere_grid(rows=400):
    """Midpoint rule over the sphere: directions [S, 3] and solid angles [S]."""
    theta = math.pi * (torch.arange(rows, dtype=DOUBLE) + 0.5) / rows
    phi = math.pi * (torch.arange(2 * rows, dtype=DOUBLE) + 0.5) / rows
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    directions = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=-1)
    return directions.reshape(-1, 3), (theta.sin() * (math.pi / rows) ** 2).reshape(-1)


def test_basis_is_scipys_real_harmonics_without_the_condon_shortley_sign():
    bands = 8
    directions = random_directions(50)
    theta = np.arccos(directions[:, 2].numpy())
    phi = np.arctan2(directions[:, 1].numpy(), directions[:, 0].numpy())
    expected = []
    for band in range(bands):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** abs(m)
            part = value.real if m >= 0 else value.imag
            expected.append(part * (math.sqrt(2) if m else 1.0))
    # Both are double precision recurrences of a few steps.
    np.testing.assert_allclose(sh_basis(directions, bands).numpy(), np.stack(expected, axis=-1), atol=1e-12)


def test_first_nine_functions_have_the_published_constants():
    x, y, z = direction = torch.tensor([0.48, -0.6, 0.64], dtype=DOUBLE)
    published = [
        0.282095,
        0.488603 * y,
        0.488603 * z,
        0.488603 * x,
        1.092548 * x * y,
        1.092548 * y * z,
        0.315392 * (3 * z * z - 1),
        1.092548 * x * z,
        0.546274 * (x * x - y * y),
    ]
    # Ramamoorthi and Hanrahan 2001, eq. 3, prints six digits.
    np.testing.assert_allclose(sh_basis(direction, 3).numpy(), np.array(published, dtype=float), atol=1e-6)


def test_basis_is_finite_and_differentiable_at_the_poles():
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(lambda n: sh_basis(n, 5), poles)


def test_basis_is_orthonormal_over_the_sphere():
    directions, solid_angles = sphere_grid()
    basis = sh_basis(directions, 5)
    # The midpoint rule on 400 rows is off by (pi / 400)^2 times the band, squared, over 24.
    np.testing.assert_allclose((basis.T * solid_angles) @ basis, np.eye(25), atol=1e-4)


def test_cosine_convolution_is_the_published_series_and_the_integral_of_a_clamped_cosine():
    factors = cosine_convolution(7)
    # Ramamoorthi and Hanrahan 2001 print six digits.
    np.testing.assert_allclose(factors[:5], [3.141593, 2.094395, 0.785398, 0.0, -0.130900], atol=1e-6)
    directions, solid_angles = sphere_grid()
    clamped = directions[:, 2].clamp(min=0.0)[:, None]
    zonal = project_to_sh(clamped, directions, solid_angles, 7)[:, 0]
    for band, factor in enumerate(factors):
        # The coefficient of a zonal kernel is A_l sqrt((2l + 1) / 4 pi); tolerance as for the midpoint rule.
        expected = factor * math.sqrt((2 * band + 1) / (4 * math.pi))
        assert zonal[band * band + band] == pytest.approx(expected, abs=1e-4)


def test_quadratic_form_is_the_irradiance_of_three_bands():
    coefficients, normals = random_coefficients(3), random_directions(100)
    form = quadratic_irradiance(irradiance_matrix(coefficients), normals)
    torch.testing.assert_close(form, sh_irradiance(coefficients, normals), rtol=0, atol=1e-12)


def test_matrix_is_symmetric_linear_and_gives_the_form_by_plain_products():
    first, second = random_coefficients(3, 1), random_coefficients(3, 2)
    matrix = irradiance_matrix(first)
    torch.testing.assert_close(matrix, matrix.transpose(1, 2))
    torch.testing.assert_close(irradiance_matrix(first + 2 * second), matrix + 2 * irradiance_matrix(second))
    normal = random_directions(1)[0]
    extended = torch.cat([normal, torch.ones(1, dtype=DOUBLE)])
    torch.testing.assert_close(quadratic_irradiance(matrix, normal), (matrix @ extended) @ extended)


def test_irradiance_of_projected_light_is_the_integral_when_the_light_has_three_bands():
    coefficients, normals = random_coefficients(3), random_directions(20)
    directions, solid_angles = sphere_grid(200)
    radiance = sh_basis(directions, 3) @ coefficients
    integral = (normals @ directions.T).clamp(min=0.0) @ (radiance * solid_angles[:, None])
    # Midpoint rule with 200 rows across the kink of the cosine.
    torch.testing.assert_close(sh_irradiance(coefficients, normals), integral, rtol=0, atol=2e-3)


@pytest.mark.parametrize("bands", [1, 2, 3, 5])
def test_rotated_coefficients_are_the_rotated_function(bands):
    coefficients, directions = random_coefficients(bands), random_directions(30)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=DOUBLE))[0]
    rotation = rotation * torch.det(rotation).sign()
    rotated = rotate_sh(coefficients, rotation)
    # Rounding of a well-conditioned least squares problem.
    torch.testing.assert_close(
        sh_basis(directions @ rotation.T, bands) @ rotated,
        sh_basis(directions, bands) @ coefficients,
        rtol=0,
        atol=1e-11,
    )


def test_rotation_about_up_takes_front_to_left():
    front = torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE)
    # cos(90 degrees) is 6e-17 in double precision.
    torch.testing.assert_close(
        rotation_about_up(90.0) @ front, torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE), rtol=0, atol=1e-15
    )


def test_gradients_match_finite_differences():
    coefficients = random_coefficients(3).requires_grad_()
    normals = random_directions(4).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, n: quadratic_irradiance(irradiance_matrix(c), n), (coefficients, normals)
    )
    assert torch.autograd.gradcheck(sh_irradiance, (random_coefficients(4).requires_grad_(), normals))


def test_wrong_numbers_of_coefficients_are_refused():
    with pytest.raises(ValueError, match="10 coefficients"):
        sh_irradiance(torch.zeros(10, 3), torch.zeros(1, 3))
    with pytest.raises(ValueError, match="needs 9"):
        irradiance_matrix(torch.zeros(4, 3))
    with pytest.raises(ValueError, match="at least one band"):
        sh_basis(torch.zeros(1, 3), 0)
