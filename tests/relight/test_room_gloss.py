"""Gloss of the room against a glossy ball in a room of formulas, and where there is nothing to find."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, looking_at, photograph, sphere_portrait

from relight.alignment import Similarity
from relight.cloud import CloudConfig
from relight.errors import PortraitError
from relight.maps import render_maps
from relight.photometric import SolveConfig, solve
from relight.portrait import FIELDS_FILE, load_portrait
from relight.reflectance import Reflectance
from relight.room_gloss import BANDS, RoomGloss, fit_room_gloss
from relight.spherical_harmonics import sh_basis

RADIUS = 0.1
GLOSSY = Reflectance(0.0, 0.25, 0.04)
WINDOW = torch.nn.functional.normalize(torch.tensor([0.5, 0.6, 0.6]), dim=0)


def spiral(count):
    """Unit directions [count, 3], nearly even."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return torch.from_numpy(np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)).float()


NORMALS = spiral(1500)
POINTS = RADIUS * NORMALS
GLOSS = 1.0 + 0.3 * torch.sin(40.0 * POINTS[:, 0])
DIFFUSE = (0.3 + 0.1 * torch.sin(30.0 * POINTS)) * (0.7 + 0.3 * NORMALS @ WINDOW)[:, None]


def room(directions):
    """Radiance [..., 3] that a blurred mirror shows: grey walls and a wide, warm window."""
    lobe = torch.exp(4.0 * (directions @ WINDOW - 1.0))
    return 0.3 + 4.0 * lobe[..., None] * torch.tensor([1.0, 0.9, 0.7])


def centres(count, span_deg, lift_m=0.12):
    """Places [count, 3] of cameras on an arc, alternately higher and lower."""
    angle = np.radians(np.linspace(-span_deg, span_deg, count))
    height = lift_m * np.sin(2.1 * np.arange(count))
    return torch.from_numpy(np.stack([0.5 * np.sin(angle), height, 0.5 * np.cos(angle)], axis=1)).float()


def frames(places, gloss=GLOSS, noise=0.0):
    """Radiance [K, P, 3] by Schlick's Fresnel term and the mirrored room, and weights [K, P]."""
    towards = torch.nn.functional.normalize(places[:, None] - POINTS, dim=-1)
    cosine = (towards * NORMALS).sum(dim=-1)
    mirrored = 2.0 * cosine[..., None] * NORMALS - towards
    fresnel = GLOSSY.f0 + (1.0 - GLOSSY.f0) * (1.0 - cosine.clamp(0.0, 1.0)) ** 5
    radiance = DIFFUSE + (gloss * fresnel)[..., None] * room(mirrored)
    random = torch.Generator().manual_seed(1)
    radiance = radiance + noise * torch.randn(radiance.shape, generator=random)
    return radiance, (cosine - 0.2).clamp(min=0.0)


def fitted(places, gloss=GLOSS, noise=0.0, reflectance=GLOSSY):
    radiance, weight = frames(places, gloss, noise)
    return fit_room_gloss(POINTS, NORMALS, gloss, reflectance, radiance, weight, places)


def mean_over(radiance, weight):
    return (weight[..., None] * radiance).sum(dim=0) / weight.sum(dim=0).clamp(min=1e-6)[:, None]


def brightest(gloss):
    """Largest of what a fit says is mirrored from anywhere, seen or not."""
    return float((sh_basis(spiral(2000), BANDS) @ gloss.coefficients).abs().max())


def root_mean_square(values):
    return float(values.double().square().mean().sqrt())


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_views_between_the_frames_are_foretold_four_times_as_well_as_by_the_mean(noise):
    places = centres(24, 80.0)
    gloss = fitted(places, noise=noise)
    radiance, weight = frames(places, noise=noise)
    diffuse = mean_over(radiance, weight) - gloss.mean_radiance(
        POINTS, NORMALS, GLOSS, GLOSSY, weight, places
    )
    new = centres(47, 80.0)[1::2]
    truth, seen = frames(new)
    on = (seen > 0) & (weight.sum(dim=0) > 0.5)
    by_mean = (mean_over(radiance, weight) - truth)[on]
    added = gloss.radiance(POINTS, NORMALS, GLOSS, new[:, None], GLOSSY)
    # Five bands leave some of the window, and the ridge holds a tenth back; 0.01 of noise is less than that.
    assert root_mean_square((diffuse + added - truth)[on]) < 0.25 * root_mean_square(by_mean)


def test_diffuse_part_and_gloss_give_the_frames_back():
    places = centres(24, 80.0)
    radiance, weight = frames(places)
    gloss = fitted(places)
    diffuse = mean_over(radiance, weight) - gloss.mean_radiance(
        POINTS, NORMALS, GLOSS, GLOSSY, weight, places
    )
    again = diffuse + gloss.radiance(POINTS, NORMALS, GLOSS, places[:, None], GLOSSY)
    by_mean = (mean_over(radiance, weight) - radiance)[weight > 0]
    assert root_mean_square((again - radiance)[weight > 0]) < 0.25 * root_mean_square(by_mean)


def test_from_where_no_camera_was_it_promises_no_more_than_the_room_has():
    # The back was not seen, nor what it mirrors: true up to 4.3, and the ridge draws what is unknown to 0.
    for places in (centres(24, 80.0), centres(24, 30.0), centres(24, 10.0)):
        assert brightest(fitted(places, noise=0.01)) < 4.3


def test_frames_from_nearly_one_place_make_no_gloss_of_their_noise():
    for span_deg in (1.0, 0.1, 0.01, 0.0):
        gloss = fitted(centres(3, span_deg, lift_m=0.0), noise=0.03)
        assert gloss is None or brightest(gloss) < 4.3
    # Not even gloss is found where nothing moves.
    assert brightest(fitted(centres(3, 0.01, lift_m=0.0), noise=0.03)) < 0.3


def test_what_has_no_gloss_has_none_and_few_frames_show_none():
    places = centres(12, 60.0)
    assert fitted(places, reflectance=Reflectance()) is None
    assert fitted(places, gloss=torch.zeros_like(GLOSS)) is None
    assert fitted(places[:2]) is None
    assert fitted(places[:1]) is None
    assert fitted(places[:0]) is None
    radiance, weight = frames(places)
    nothing = torch.zeros_like(weight)
    assert fit_room_gloss(POINTS, NORMALS, GLOSS, GLOSSY, radiance, nothing, places) is None


def test_matte_points_among_glossy_ones_stay_as_they_are_and_do_not_disturb():
    places = centres(24, 80.0)
    part = torch.where(POINTS[:, 1] > 0, GLOSS, 0.0)
    gloss = fitted(places, gloss=part)
    added = gloss.radiance(POINTS, NORMALS, part, places[:, None], GLOSSY)
    assert not added[:, part == 0].any()
    radiance, weight = frames(places, gloss=part)
    moving = radiance - mean_over(radiance, weight)
    left = moving - (added - gloss.mean_radiance(POINTS, NORMALS, part, GLOSSY, weight, places))
    assert root_mean_square(left[weight > 0]) < 0.3 * root_mean_square(moving[weight > 0])


def test_a_frame_that_shows_something_else_counts_for_little():
    places = centres(24, 80.0)
    radiance, weight = frames(places)
    radiance[5] += 0.5
    gloss = fit_room_gloss(POINTS, NORMALS, GLOSS, GLOSSY, radiance, weight, places)
    clean = fitted(places)
    directions = spiral(500)
    directions = directions[directions[:, 2] > 0]
    difference = sh_basis(directions, BANDS) @ (gloss.coefficients - clean.coefficients)
    # A hand before one camera of 24 is not in the model; it moves what is mirrored by less than the walls'.
    assert root_mean_square(difference) < 0.3


def test_more_points_than_are_fitted_at_once_give_the_same(monkeypatch):
    whole = fitted(centres(6, 60.0))
    monkeypatch.setattr("relight.room_gloss._CHUNK", 400)
    # Another order of float32 sums.
    np.testing.assert_allclose(
        fitted(centres(6, 60.0)).coefficients, whole.coefficients, atol=1e-3 * brightest(whole)
    )


def test_from_behind_the_surface_nothing_is_added():
    gloss = RoomGloss(torch.ones(BANDS**2, 3))
    inside = gloss.radiance(POINTS, NORMALS, GLOSS, torch.zeros(3), GLOSSY)
    assert not inside.any()
    on_point = gloss.radiance(POINTS, NORMALS, GLOSS, POINTS[0], GLOSSY)
    assert bool(on_point.isfinite().all())


def test_the_mean_over_cameras_is_that_of_a_loop_over_them():
    places = centres(9, 80.0)
    _, weight = frames(places)
    weight[:, 7] = 0.0  # a point that nobody sees
    gloss = fitted(places)
    expected = np.zeros((len(POINTS), 3))
    for point in range(0, len(POINTS), 50):
        total = 0.0
        for camera, place in enumerate(places):
            share = float(weight[camera, point])
            if share > 0:
                added = gloss.radiance(POINTS[point], NORMALS[point], GLOSS[point], place, GLOSSY)
                expected[point] += share * added.double().numpy()
                total += share
        expected[point] /= max(total, 1e-6)
    found = gloss.mean_radiance(POINTS, NORMALS, GLOSS, GLOSSY, weight, places)
    np.testing.assert_allclose(found[::50], expected[::50], atol=1e-5)
    assert not found[7].any()


def test_the_mean_over_many_cameras_is_nearly_that_over_all(monkeypatch):
    places = centres(72, 80.0, lift_m=0.0)
    _, weight = frames(places)
    gloss = fitted(places)
    some = gloss.mean_radiance(POINTS, NORMALS, GLOSS, GLOSSY, weight, places)
    monkeypatch.setattr("relight.room_gloss._MEAN_CAMERAS", 72)
    every = gloss.mean_radiance(POINTS, NORMALS, GLOSS, GLOSSY, weight, places)
    # 24 cameras are 7 degrees apart; a point at the rim is seen by few of them, under a strong Fresnel term.
    on = weight.sum(dim=0) > 5.0
    assert root_mean_square((some - every)[on]) < 0.02 * root_mean_square(every[on])


def glossy_portrait(**given):
    """A ball whose gloss mirrors something from everywhere."""
    random = torch.Generator().manual_seed(3)
    coefficients = torch.randn(BANDS**2, 3, generator=random)
    portrait = sphere_portrait(6000, room_radiance=0.5, reflectance=GLOSSY, **given)
    return replace(portrait, room_gloss=RoomGloss(coefficients))


def test_a_view_of_a_portrait_has_the_gloss_of_its_own_camera():
    portrait = glossy_portrait()
    camera = looking_at(np.array([0.2, 0.1, 0.4]), np.zeros(3), size=48)
    plain, maps = (render_maps(p, camera) for p in (replace(portrait, room_gloss=None), portrait))
    on = maps.mask > 0
    centre = torch.from_numpy(camera.centre_world).float()
    added = portrait.room_gloss.radiance(
        maps.points_world[on], maps.normals_world[on], maps.gloss[on], centre, GLOSSY
    )
    np.testing.assert_allclose(
        maps.room_radiance[on], (plain.room_radiance[on] + added).clamp(min=0), atol=1e-6
    )
    assert not maps.room_radiance[~on].any()
    assert root_mean_square(added) > 0.02


def test_a_portrait_that_is_turned_looks_the_same_to_a_camera_that_is_taken_along():
    portrait = glossy_portrait()
    camera = looking_at(np.array([0.2, 0.1, 0.4]), np.zeros(3), size=48)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    similarity = Similarity(1.5, turn * np.sign(np.linalg.det(turn)), np.array([0.3, -0.1, 0.2]))
    before = render_maps(portrait, camera)
    after = render_maps(portrait.transformed(similarity), similarity.camera(camera))
    on = (before.mask > 0.5) & (after.mask > 0.5)
    assert on.sum() > 300
    # Points keep their pixels but for rounding, which may move one across an edge: a few pixels in a hundred.
    apart = (before.room_radiance - after.room_radiance)[on].abs().amax(dim=-1)
    assert float((apart < 1e-3).float().mean()) > 0.97
    # What is mirrored differs by far more than that from view to view.
    other = render_maps(portrait, looking_at(np.array([-0.2, 0.1, 0.4]), np.zeros(3), size=48))
    assert float((other.room_radiance - before.room_radiance)[on].abs().mean()) > 0.02


def test_it_is_saved_with_the_portrait_and_read_again_bit_by_bit(tmp_path):
    portrait = glossy_portrait()
    portrait.save(tmp_path)
    again = load_portrait(tmp_path)
    np.testing.assert_array_equal(again.room_gloss.coefficients, portrait.room_gloss.coefficients)
    np.testing.assert_array_equal(again.to("cpu").room_gloss.coefficients, portrait.room_gloss.coefficients)
    part = again.subset(torch.arange(5))
    np.testing.assert_array_equal(part.room_gloss.coefficients, portrait.room_gloss.coefficients)


@pytest.mark.parametrize(
    "rows", [[[1.0, 2.0, 3.0]] * 3, [], [[1.0, 2.0]], "gloss", [[None] * 3], [["a"] * 3], 4]
)
def test_coefficients_that_are_none_are_refused(tmp_path, rows):
    glossy_portrait().save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    (tmp_path / FIELDS_FILE).write_text(json.dumps(content | {"room_gloss": rows}))
    with pytest.raises(PortraitError, match="damaged"):
        load_portrait(tmp_path)


@pytest.fixture(scope="module")
def shining():
    """Frames of a head that is glossy under the flash and in the room; the last four are kept back."""
    head = Head(f0=0.04)
    taken = [photograph(head, camera) for camera in arc(count=24, size=64)]

    def shone(frame):
        """The frame with what the head's gloss mirrors of the room."""
        hit = frame.hit
        normals = torch.from_numpy(frame.normals[hit]).float()
        towards = frame.camera.centre_world - frame.points[hit]
        towards = torch.nn.functional.normalize(torch.from_numpy(towards).float(), dim=-1)
        cosine = (normals * towards).sum(dim=-1, keepdim=True)
        fresnel = head.f0 + (1 - head.f0) * (1 - cosine.clamp(0, 1)) ** 5
        radiance = frame.radiance.copy()
        radiance[hit] += (fresnel * room(2 * cosine * normals - towards)).numpy()
        return radiance

    points, normals = (torch.from_numpy(part) for part in cloud_of(head, 3000))
    kept = [k for k, frame in enumerate(taken) if not frame.camera.flash][2::4]
    fit = [k for k in range(len(taken)) if k not in kept]
    scene = MemoryScene([taken[k] for k in fit], [shone(taken[k]) for k in fit], points, normals)
    return scene, [(taken[k], shone(taken[k])) for k in kept]


def test_the_solve_shows_new_views_of_a_glossy_head_better_with_the_rooms_gloss(shining):
    scene, kept = shining
    errors = []
    for room_gloss in (False, True):
        config = SolveConfig(cloud=CloudConfig(max_points=3000), room_gloss=room_gloss)
        portrait = solve(scene, config)
        assert (portrait.room_gloss is not None) == room_gloss
        squares = []
        for frame, radiance in kept:
            maps = render_maps(portrait, frame.camera)
            inside = (maps.mask > 0.99) & torch.from_numpy(frame.hit)
            difference = maps.room_radiance - torch.from_numpy(radiance).float()
            squares.append(difference[inside].square().mean())
        errors.append(float(torch.stack(squares).mean().sqrt()))
    # Half of the square at least: the rest is splatting at 64 pixels.
    assert errors[1] < 0.7 * errors[0]
