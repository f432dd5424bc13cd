"""A portrait with the paper's decoder renders, is saved and goes into other worlds like any other."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic_scene import looking_at

from relight.alignment import Similarity
from relight.errors import PortraitError
from relight.lighting import CapturedLight, FlashLight
from relight.maps import Maps, render_maps, splat_maps
from relight.neural.paper.decoder import PaperDecoder
from relight.neural.paper.lighting import flash_distance, towards_camera
from relight.neural.paper.model import PaperModel
from relight.portrait import load_portrait
from relight.render import render_view

CAMERA = looking_at(np.array([0.1, 0.05, 0.45]), np.zeros(3), size=80, flash=1)


@pytest.fixture(scope="module")
def portrait(solved):
    """The solved head with a decoder without training: its maps are anything, but the same every time."""
    grey = torch.full((3,), 0.3)
    model = PaperModel(len(solved.points), grey, grey, None, torch.Generator().manual_seed(0)).eval()
    decoder = PaperDecoder(model.network, model.descriptors.detach(), torch.eye(3, dtype=torch.float64))
    return replace(solved, decoder=decoder, c_room=(0.3, 0.4, 0.5), c_flash=(0.1, 0.09, 0.08))


def test_its_maps_have_the_views_size_and_are_0_where_the_mask_is(portrait):
    maps = render_maps(portrait, CAMERA)
    for field in fields(Maps):
        values = getattr(maps, field.name)
        if values is None:  # what only other decoders give
            continue
        assert values.shape[:2] == (80, 80)
        assert bool(values.isfinite().all())
        if field.name != "point_ids":
            assert not values[maps.mask == 0].any()
    on = maps.mask > 0
    np.testing.assert_allclose(torch.linalg.vector_norm(maps.normals_world[on], dim=-1), 1.0, atol=1e-5)
    assert bool((maps.depth[on] > 0.3).all())


def test_depth_and_confidence_are_those_of_the_points(portrait):
    maps, splats = render_maps(portrait, CAMERA), splat_maps(portrait, CAMERA)
    both = (maps.mask > 0) & (splats.mask > 0)
    assert both.sum() > 500
    np.testing.assert_array_equal(maps.depth[both], splats.depth[both])
    np.testing.assert_array_equal(maps.confidence[both], splats.confidence[both])


def test_the_captured_light_is_eq_6(portrait):
    maps, radiances = render_view(portrait, CAMERA, {"captured": CapturedLight(), "flash": FlashLight()})
    on = maps.mask > 0
    room = maps.albedo * torch.tensor(portrait.c_room) * maps.shading[..., None]
    cosine = (maps.normals_world @ towards_camera(CAMERA)).clamp(min=0.0)[..., None]
    square = flash_distance(portrait.points, CAMERA) ** 2
    flash = maps.albedo * torch.tensor(portrait.c_flash) / square * cosine
    # float32, in another order.
    np.testing.assert_allclose(radiances["flash"][on], flash[on], atol=1e-6)
    np.testing.assert_allclose(radiances["captured"][on], (room + flash)[on], atol=1e-6)


def test_a_view_is_the_same_whatever_part_of_the_picture_the_points_take(portrait):
    # The same view with 48 pixels more on the left and above: the box of the points moves along.
    intrinsics = CAMERA.K.copy()
    intrinsics[:2, 2] += 48
    wide = replace(CAMERA, width=128, height=128, K=intrinsics)
    # Network and rasteriser do not know where in the picture they are, but for halvings; beyond the points,
    # where features are nearly zero, a normalisation makes much of what little the box's edge changes.
    near, far = (portrait.decoder.neural_maps(portrait.points, camera) for camera in (CAMERA, wide))
    inside = np.s_[:, 8:72, 8:72]
    np.testing.assert_allclose(
        near.albedo[inside], far.albedo[:, 48:, 48:][inside], atol=0.1, err_msg="near the box's edge too"
    )


def test_where_no_point_is_there_is_nothing(portrait):
    away = looking_at(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]), size=16)
    maps = render_maps(portrait, away)
    assert not maps.mask.any()
    assert bool((maps.point_ids == -1).all())


def test_it_comes_back_from_the_disk_as_it_was(portrait, tmp_path):
    portrait.save(tmp_path)
    again = load_portrait(tmp_path)
    before, after = (render_maps(each, CAMERA) for each in (portrait, again))
    for field in fields(Maps):
        np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name))


def test_in_another_world_it_looks_the_same(portrait):
    angle = np.radians(40.0)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    similarity = Similarity(3.0, rotation, np.array([0.4, -0.2, 0.1]))
    there = portrait.transformed(similarity)
    before, lit_before = render_view(portrait, CAMERA, {"captured": CapturedLight()})
    after, lit_after = render_view(there, similarity.camera(CAMERA), {"captured": CapturedLight()})
    # Rounding moves a point across a pixel's edge here and there; all else is as before.
    same = (before.albedo - after.albedo).abs().amax(dim=-1) < 1e-3
    assert float(same.float().mean()) > 0.98
    turned = before.normals_world @ torch.tensor(rotation.T, dtype=torch.float32)
    on = same & (before.mask > 0) & (after.mask > 0)
    np.testing.assert_allclose(turned[on], after.normals_world[on], atol=0.02)
    np.testing.assert_allclose(lit_before["captured"][on], lit_after["captured"][on], atol=0.02)


def test_a_subset_keeps_the_descriptors_of_its_points(portrait):
    keep = torch.arange(len(portrait.points)) % 3 == 0
    part = portrait.subset(keep)
    np.testing.assert_array_equal(part.decoder.descriptors, portrait.decoder.descriptors[keep])
    assert render_maps(part, CAMERA).mask.shape == (80, 80)


def test_settings_and_tensors_that_are_not_a_decoders_are_refused(portrait, tmp_path):
    settings, tensors = portrait.decoder.settings(), portrait.decoder.tensors()
    for wrong in (
        {"turn": [[1.0]]},
        {"turn": [[float("nan")] * 3] * 3},
        {"precision": "half"},
    ):
        with pytest.raises(ValueError, match=r"rotation|precision"):
            PaperDecoder.restored(settings | wrong, tensors)
    with pytest.raises(KeyError):
        PaperDecoder.restored({}, tensors)
    with pytest.raises(ValueError, match="descriptors"):
        PaperDecoder.restored(settings, tensors | {"descriptors": torch.zeros(4, 3)})
    lost = {name: values for name, values in tensors.items() if "last" not in name}
    with pytest.raises(ValueError, match="other layers"):
        PaperDecoder.restored(settings, lost)
    replace(portrait, decoder=replace(portrait.decoder, descriptors=torch.zeros(4, 3))).save(tmp_path)
    with pytest.raises(PortraitError, match="damaged"):
        load_portrait(tmp_path)
