"""The composite loss is the weighted sum of its terms; what is not known of a pixel costs nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from relight.face.textures import PositionMap
from relight.neural.display import display_values
from relight.neural.frames import Target
from relight.neural.losses.mismatch import Mismatch, pooled_l1
from relight.neural.paper.config import PaperConfig
from relight.neural.paper.faces import FacePatch
from relight.neural.paper.heads import neural_maps
from relight.neural.paper.objective import FaceTextures, Objective

SIZE = 16
CONFIG = PaperConfig(crop=SIZE)
OBJECTIVE = Objective(CONFIG, Mismatch(lambda a, b: (a - b).square().mean()))


def chance(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def some_maps():
    return neural_maps(chance(1, 8, SIZE, SIZE, seed=1) - 0.5)


def some_target(**changes):
    parts = {
        "radiance": chance(3, SIZE, SIZE, seed=2),
        "valid": torch.ones(1, SIZE, SIZE),
        "inside": torch.ones(1, SIZE, SIZE),
        "mask": (chance(1, SIZE, SIZE, seed=3) > 0.3).float(),
    }
    return Target(**(parts | changes))


def some_face():
    v, u = torch.meshgrid(torch.arange(256), torch.arange(256), indexing="ij")
    uv_px = torch.stack([u, v], dim=-1) * (SIZE / 256)
    normals = torch.nn.functional.normalize(chance(3, SIZE, SIZE, seed=4) - 0.5, dim=0)
    return FacePatch(PositionMap(uv_px, torch.ones(256, 256)), normals, torch.ones(1, SIZE, SIZE))


def some_textures():
    known = torch.ones(256, 256)
    return FaceTextures(chance(3, 256, 128, seed=5), chance(3, 256, 256, seed=6), known, known)


def test_the_weights_are_the_papers():
    weights = (CONFIG.weight_normal, CONFIG.weight_symmetry, CONFIG.weight_colour)
    assert weights == (0.1, 0.02, 100.0)
    assert (CONFIG.weight_shading, CONFIG.weight_mask, CONFIG.beta) == (50.0, 1000.0, 2500.0)
    usual = PaperConfig()
    assert (usual.steps, usual.crop) == (80_000, 512)


def test_without_a_face_there_are_the_three_terms_of_any_scene():
    maps, image, target = some_maps(), chance(3, SIZE, SIZE), some_target()
    terms = OBJECTIVE.terms(maps, image, target)
    assert set(terms) == {"final", "mask", "shading"}
    shown, seen = (display_values(each) * target.mask for each in (image, target.radiance))
    expected = (shown - seen).square().mean() + 2500.0 * pooled_l1(shown[None], seen[None])
    np.testing.assert_allclose(terms["final"], expected, rtol=1e-5)
    overlap = 2.0 * (maps.mask * target.mask).sum() + 0.1
    dice = overlap / (maps.mask.sum() + target.mask.sum() + 0.1)
    np.testing.assert_allclose(terms["mask"], -1000.0 * torch.log(dice), rtol=1e-5)
    shading = maps.shading[0].numpy()
    variation = np.abs(np.diff(shading, axis=0)).mean() + np.abs(np.diff(shading, axis=1)).mean()
    np.testing.assert_allclose(terms["shading"], 50.0 * variation, rtol=1e-5)


def test_with_a_face_there_are_its_three_terms_too():
    maps, face, textures = some_maps(), some_face(), some_textures()
    terms = OBJECTIVE.terms(maps, chance(3, SIZE, SIZE), some_target(), face, textures)
    assert set(terms) == {"final", "mask", "shading", "symmetry", "colour", "normal"}
    difference = maps.normals_world - face.normals_world
    expected = difference.square().mean() + 2500.0 * pooled_l1(
        maps.normals_world[None], face.normals_world[None]
    )
    np.testing.assert_allclose(terms["normal"], 0.1 * expected, rtol=1e-5)
    other = replace(textures, colour=textures.colour + 0.25)
    further = OBJECTIVE.terms(maps, chance(3, SIZE, SIZE), some_target(), face, other)
    # Albedo lies between 0.37 and 0.63 by its sigmoid; all else is as before.
    assert further["colour"] != terms["colour"]
    assert further["symmetry"] == terms["symmetry"]


def test_what_is_clipped_or_beyond_the_frame_draws_no_picture():
    maps, target = some_maps(), some_target()
    valid = (chance(1, SIZE, SIZE, seed=7) > 0.5).float()
    target = replace(target, valid=valid, radiance=target.radiance * valid)
    image = chance(3, SIZE, SIZE).requires_grad_(True)
    OBJECTIVE.terms(maps, image, target)["final"].backward()
    unknown = (valid * target.mask)[0] == 0
    assert not image.grad[:, unknown].any()
    assert bool(image.grad[:, ~unknown].any())


def test_the_mask_is_not_asked_for_beyond_the_frame():
    inside = torch.ones(1, SIZE, SIZE)
    inside[..., 8:] = 0.0
    channels = (chance(1, 8, SIZE, SIZE, seed=1) - 0.5).requires_grad_(True)
    OBJECTIVE.terms(neural_maps(channels), chance(3, SIZE, SIZE), some_target(inside=inside))[
        "mask"
    ].backward()
    assert not channels.grad[0, 7, :, 8:].any()
    assert bool(channels.grad[0, 7, :, :8].all())


@pytest.mark.parametrize("radiance", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("mask", [0.0, 1.0])
def test_black_white_and_empty_pictures_have_finite_losses_and_gradients(radiance, mask):
    target = some_target(
        radiance=torch.full((3, SIZE, SIZE), radiance), mask=torch.full((1, SIZE, SIZE), mask)
    )
    channels = torch.zeros(1, 8, SIZE, SIZE, requires_grad=True)
    maps = neural_maps(channels)
    image = maps.albedo * maps.normals_world.sum(dim=0)
    terms = OBJECTIVE.terms(maps, image, target, some_face(), some_textures())
    torch.stack(list(terms.values())).sum().backward()
    assert all(bool(term.isfinite()) for term in terms.values())
    assert bool(channels.grad.isfinite().all())
