"""What a patch knows of the face is what its frame knows, and the textures begin as the paper has it."""

import numpy as np
import pytest
import torch
from analytic_scene import Head, photograph

from capture.transfer import to_display
from relight.neural.crops import Crop
from relight.neural.paper.faces import FacePatches
from relight.neural.paper.fitting import PaperFit
from relight.neural.perceptual import laplacian_perceptual


@pytest.fixture(scope="module")
def view(scene, face):
    return next(v for v in scene.views if v.index in face.cameras and v.index >= 8)


def test_normals_of_a_patch_are_those_of_the_head(face, view):
    crop = Crop(left=16, top=18, side=32, size=48)
    patch = FacePatches(face).of(view, crop)
    on = patch.mask[0] > 0
    assert float(on.float().mean()) > 0.4
    frame = photograph(Head(), crop.camera(view.camera))
    cosine = (patch.normals_world.permute(1, 2, 0).numpy() * frame.normals).sum(axis=-1)[on.numpy()]
    # Drawn at the frame's pixels and interpolated: bumps turn normals by 3 degrees within a pixel.
    assert np.degrees(np.median(np.arccos(cosine.clip(-1, 1)))) < 3.0
    np.testing.assert_allclose(torch.linalg.vector_norm(patch.normals_world, dim=0)[on], 1.0, atol=1e-5)
    assert not patch.normals_world[:, ~on].any()


def test_texels_lie_in_a_patch_where_they_lie_in_the_frame(face, view):
    crop = Crop(left=10, top=12, side=40, size=80)
    whole, patch = face.position_map(view.index), FacePatches(face).of(view, crop).position_map
    np.testing.assert_allclose(patch.uv_px, 2 * (whole.uv_px - torch.tensor([10.0, 12.0])), atol=1e-3)
    np.testing.assert_array_equal(patch.cosine, whole.cosine)


def test_a_frame_that_does_not_show_the_face_has_no_patch(scene, face):
    aside = [view for view in scene.views if view.index not in face.cameras]
    assert aside
    assert FacePatches(face).of(aside[0], Crop(0, 0, 64, 32)) is None


@pytest.fixture(scope="module")
def fit(scene, solved, config, face):
    return PaperFit(scene, solved, config, laplacian_perceptual, face, 0)


def test_the_colour_texture_is_the_median_of_the_lit_frames_that_are_fitted(fit, scene, face):
    lit = [view for view in fit.fitted if view.flash == 1 and view.index in face.cameras]
    assert len(lit) >= 2
    texel = (120, 90)
    colours = []
    for view in lit:
        position = face.position_map(view.index)
        if float(position.cosine[texel]) > 0.2:
            u, v = position.uv_px[texel].tolist()
            picture = to_display(np.clip(scene.frames[view.index].radiance, 0, None))
            column, row = u - 0.5, v - 0.5
            i, j, a, b = int(row), int(column), row % 1, column % 1
            corners = picture[i : i + 2, j : j + 2]
            upper, lower = ((1 - b) * corners[k, 0] + b * corners[k, 1] for k in (0, 1))
            colours.append((1 - a) * upper + a * lower)
    # torch's median of an even number is the lower of the two in the middle.
    expected = np.sort(np.stack(colours), axis=0)[(len(colours) - 1) // 2]
    np.testing.assert_allclose(fit._textures.colour[(slice(None), *texel)], expected, atol=2e-3)


def test_the_half_texture_begins_as_the_mean_of_both_sides(fit):
    colour, known = fit._textures.colour, fit._textures.known
    both = (known[:, :128] > 0) & (known.flip(-1)[:, :128] > 0)
    assert float(both.float().mean()) > 0.5
    expected = 0.5 * (colour[:, :, :128] + colour.flip(-1)[:, :, :128])
    np.testing.assert_allclose(fit.model.half_texture.detach()[:, both], expected[:, both], atol=1e-5)


def test_the_half_texture_is_learned_at_a_rate_of_its_own(fit):
    before = fit.model.half_texture.detach().clone()
    terms = {}
    for _ in range(8):
        terms |= fit.advance()
    assert {"symmetry", "colour", "normal"} < set(terms)
    moved = (fit.model.half_texture.detach() - before).abs().max()
    # Adam moves a number by no more than about its rate a step.
    assert 0 < float(moved) < 8 * 2 * fit.config.rate_texture
    rates = [group["lr"] for group in fit.model.groups(fit.config)]
    assert len(rates) == 4
