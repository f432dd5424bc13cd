import numpy as np
import pytest

from capture.sim.environment import (
    Environment,
    SoftBox,
    fibonacci_directions,
    latlong_directions,
    look_up,
    studio_map,
)


def test_solid_angles_fill_the_sphere_and_directions_follow_the_convention() -> None:
    directions, solid = latlong_directions(64, 128)
    assert solid.sum() == pytest.approx(4 * np.pi, rel=1e-3)  # midpoint rule over 64 rows
    assert directions[0, 0, 1] > 0.99  # the first row looks up
    assert np.allclose(directions[32, 64], [0, 0, 1], atol=0.05)  # the middle looks along +z


def test_even_light_gives_even_irradiance_and_mirrors_evenly() -> None:
    environment = Environment.from_map(np.full((32, 64, 3), [1.0, 2.0, 3.0]))
    normals = fibonacci_directions(200).astype(np.float32)
    # The midpoint rule on a map of 32 rows is good to half a percent.
    assert np.allclose(look_up(environment.diffuse, normals), [1, 2, 3], rtol=5e-3)
    assert np.allclose(look_up(environment.mirrored, normals), [1, 2, 3], rtol=1e-4)


def test_irradiance_agrees_with_a_sum_over_the_map() -> None:
    radiance = studio_map((0.2, 0.2, 0.3), (0.1, 0.1, 0.1), (SoftBox((1, 0.5, 0.2), 0.4, (3, 2, 1)),))
    environment = Environment.from_map(radiance)
    directions, solid = latlong_directions(*radiance.shape[:2])
    normals = fibonacci_directions(60)
    for normal, looked_up in zip(
        normals, look_up(environment.diffuse, normals.astype(np.float32)), strict=True
    ):
        cosine = np.maximum(directions @ normal, 0) * solid
        # Bilinear look-up in a table of 48 x 48 directions: below 1 % of the brightest.
        assert np.abs(looked_up - (cosine[..., None] * radiance).sum((0, 1)) / np.pi).max() < 0.01


def test_the_cells_of_a_map_hold_all_its_light() -> None:
    radiance = studio_map((0.2, 0.2, 0.3), (0.1, 0.1, 0.1), (SoftBox((0, 1, 0), 0.5, (2, 2, 2)),))
    _, solid = latlong_directions(*radiance.shape[:2])
    cells = Environment.from_map(radiance).cells(fibonacci_directions(50))
    assert np.allclose(cells.sum(axis=0), (radiance * solid[..., None]).sum((0, 1)))
