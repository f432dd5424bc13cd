"""Points take the network's maps from the frames that see them, and keep the solve's values elsewhere."""

import numpy as np
import pytest
import torch

from relight.neural.paper.baking import baked
from relight.neural.paper.heads import NeuralMaps
from relight.observations import visible_points

C_ROOM, C_FLASH = torch.tensor([0.3, 0.4, 0.5]), torch.tensor([0.1, 0.2, 0.3])
ALBEDO, NORMAL = (0.5, 0.25, 0.125), (0.6, 0.0, 0.8)


class FlatDecoder:
    """The same maps everywhere, or a brighter albedo in every other view."""

    def __init__(self, swing=0.0):
        self.swing, self.views = swing, 0

    def neural_maps(self, points, camera):
        self.views += 1
        size = (camera.height, camera.width)
        bright = 1.0 + self.swing * (-1) ** self.views
        return NeuralMaps(
            *(
                torch.tensor(values).view(-1, 1, 1).expand(-1, *size)
                for values in ([bright * a for a in ALBEDO], NORMAL, [0.75], [1.0])
            )
        )


def seen_by(solved, views):
    counts = [
        visible_points(solved.points, solved.normals_world, v.camera, solved.spacing)[1] > 0.15 for v in views
    ]
    return torch.stack(counts).sum(dim=0)


@pytest.fixture(scope="module")
def views(scene):
    return scene.views[4:8]


def test_points_that_are_seen_have_the_maps_values(scene, solved, views):
    portrait = baked(solved, FlatDecoder(), C_ROOM, C_FLASH, views)
    seen = seen_by(solved, views) > 0
    assert 0.3 < float(seen.float().mean()) < 0.95
    room = np.multiply(np.multiply(ALBEDO, C_ROOM.numpy()), 0.75)
    for name, value in (
        ("albedo", ALBEDO),
        ("normals_world", NORMAL),
        ("shading", 0.75),
        ("room_radiance", room),
    ):
        expected = torch.as_tensor(np.asarray(value, np.float32)).expand_as(getattr(portrait, name))
        np.testing.assert_allclose(getattr(portrait, name)[seen], expected[seen], atol=1e-5, err_msg=name)
    np.testing.assert_allclose(portrait.c_room, C_ROOM, rtol=1e-6)
    np.testing.assert_allclose(portrait.c_flash, C_FLASH, rtol=1e-6)
    assert portrait.flash_offset_cam_m == (0.0, 0.0, 0.0)
    assert portrait.reflectance.f0 == portrait.reflectance.retro == 0.0
    assert portrait.room_gloss is None


def test_points_that_are_not_seen_keep_the_solves_in_the_new_scale(scene, solved, views):
    portrait = baked(solved, FlatDecoder(), C_ROOM, C_FLASH, views)
    hidden = seen_by(solved, views) == 0
    ratio = portrait.albedo[hidden] / solved.albedo[hidden].clamp(min=1e-6)
    # One scale a channel: that between what is seen of both.
    np.testing.assert_allclose(ratio, ratio[:1].expand_as(ratio), rtol=1e-4)
    np.testing.assert_array_equal(portrait.normals_world[hidden], solved.normals_world[hidden])
    np.testing.assert_array_equal(portrait.room_radiance[hidden], solved.room_radiance[hidden])
    np.testing.assert_array_equal(portrait.confidence, solved.confidence)


def test_where_frames_disagree_the_spread_is_said(scene, solved):
    views = scene.views[6:10]
    portrait = baked(solved, FlatDecoder(swing=0.2), C_ROOM, C_FLASH, views)
    often = seen_by(solved, views) == 4
    assert bool(often.any())
    # Two values a fifth apart from their mean, in about equal shares: 0.2 of the mean albedo 0.2917.
    np.testing.assert_allclose(portrait.albedo_sigma[often].median(), 0.2 * np.mean(ALBEDO), rtol=0.1)
    steady = baked(solved, FlatDecoder(), C_ROOM, C_FLASH, views)
    assert float(steady.albedo_sigma[often].max()) < 1e-3
    assert float(steady.normal_sigma_rad[often].max()) < 2e-3


def test_without_a_frame_all_is_as_solved(solved):
    portrait = baked(solved, FlatDecoder(), C_ROOM, C_FLASH, ())
    np.testing.assert_array_equal(portrait.albedo, solved.albedo)
    np.testing.assert_array_equal(portrait.normals_world, solved.normals_world)
