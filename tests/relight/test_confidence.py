"""What a view says of its own reliability, on a ball of which half was seen."""

from dataclasses import replace

import numpy as np
import torch
from analytic_scene import looking_at, sphere_portrait

from relight.confidence import NAMES, confidence_maps, seen_by_any
from relight.light_spec import _TAKEN_NAMES
from relight.maps import render_maps

FRONT = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=64)
BACK = looking_at(np.array([0.0, 0.0, -0.5]), np.zeros(3), size=64)


def ball():
    """Seen by a flash on its right side (x > 0) only."""
    portrait = sphere_portrait(20_000, 0.1)
    right = (portrait.points[:, 0] > 0).float()
    return replace(
        portrait,
        confidence=0.9 * right,
        albedo_sigma=0.5 - 0.48 * right,
        normal_sigma_rad=0.06 - 0.04 * right,
    )


def test_a_camera_sees_the_side_that_faces_it():
    portrait = ball()
    z = portrait.points[:, 2] / 0.1
    seen = seen_by_any(portrait, [FRONT])
    # From 0.5 m a ball of 0.1 m shows what lies above z = 0.2 radii; a cosine of 0.1 is asked for.
    assert seen[z > 0.35].all()
    assert not seen[z < 0.2].any()
    assert seen_by_any(portrait, [FRONT, BACK])[z.abs() > 0.35].all()
    assert not seen_by_any(portrait, []).any()


def test_pixels_say_what_their_points_know():
    portrait = ball()
    maps = render_maps(portrait, FRONT)
    found = confidence_maps(portrait, maps, seen_by_any(portrait, [BACK]))
    assert tuple(found) == NAMES
    column = torch.arange(64)[None].expand(64, 64)
    inner = maps.mask > 0.99
    right, left = inner & (column > 34), inner & (column < 29)  # u is x: the camera stands at +z, y is down
    if maps.points_world[right][:, 0].mean() < 0:
        right, left = left, right
    for name, of_right, of_left in (
        ("albedo_sigma", 0.02, 0.5),
        ("normal_sigma", 0.02, 0.06),
        ("unobserved_flash", 0.0, 1.0),
    ):
        np.testing.assert_allclose(found[name][right], of_right, atol=1e-6)
        np.testing.assert_allclose(found[name][left], of_left, atol=1e-6)
    assert (found["unobserved_view"][inner] == 1).all()  # from behind nothing of it is seen
    for image in found.values():
        assert not image[maps.mask == 0].any()


def test_without_cameras_what_a_flash_frame_saw_counts_as_seen():
    portrait = ball()
    maps = render_maps(portrait, FRONT)
    found = confidence_maps(portrait, maps)
    np.testing.assert_array_equal(found["unobserved_view"], found["unobserved_flash"])


def test_pixels_without_a_point_are_unknown():
    portrait = ball()
    maps = render_maps(portrait, FRONT)
    maps = replace(maps, point_ids=torch.full_like(maps.point_ids, -1))
    for image in confidence_maps(portrait, maps).values():
        np.testing.assert_array_equal(image, (maps.mask > 0).float())


def test_no_light_may_be_called_like_one_of_these_maps():
    assert set(NAMES) <= set(_TAKEN_NAMES)
