"""Bumps that a cloud has smoothed away come back from their shading under the flash, and no others come."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import (
    C_FLASH,
    FLASH_OFFSET_CAM_M,
    Head,
    MemoryScene,
    arc,
    cloud_of,
    photograph,
    with_noise,
)

from relight.cloud import CloudConfig
from relight.height_field import HeightField
from relight.photometric import SolveConfig, solve
from relight.reflectance import Reflectance
from relight.shape_from_flash import FlashResponses, ShapeConfig, _slope_terms, refine_shape

COUNT = 9000  # points 3.7 mm apart on a head of 0.12 m^2
SPACING_M = 0.0037
HEAD = Head(bump=0.012)  # waves of 8 cm, 1.2 mm high: slopes of 0.1
SMOOTH = replace(HEAD, bump=0.0)  # what a cloud has of it that was smoothed
GLOSSY = Reflectance(alpha=0.25, f0=0.04)
CONFIG = ShapeConfig()


def degrees(normals, truth, of=slice(None)):
    """Mean angle between normals [P, 3] and true ones."""
    cosine = (np.asarray(normals, np.float64) * truth).sum(axis=1)[of]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


class Film:
    """Responses of the bumpy head at points of the smooth one, as a lamp on the arc of cameras sees them.

    Responses are made with the normals of the bumpy head from the formulas of `Head`, by numpy.
    """

    def __init__(self, head=HEAD, cloud=SMOOTH, frames=12, noise=0.01, f0=0.0, albedo=1.0, seed=0):
        self.points = cloud.surface(COUNT)
        self.cloud_normals = cloud.normals(self.points)
        self.truth = head.normals(self.points)
        head = replace(head, f0=f0, alpha=GLOSSY.alpha, albedo_gain=albedo)
        cameras = [camera for camera in arc(count=3 * frames) if camera.flash]
        random = np.random.default_rng(seed)
        response, weight, to_light = [], [], []
        for camera in cameras:
            lamp = camera.centre_world + camera.cam_from_world[:3, :3].T @ FLASH_OFFSET_CAM_M
            towards = lamp - self.points
            square = (towards**2).sum(axis=1)
            # The lamp is taken for the eye as well: the model has no angle between them.
            added = head.flash_radiance(self.points, self.truth, head.albedo(self.points), lamp, lamp)
            seen = (self.cloud_normals * towards).sum(axis=1) > 0.1 * np.sqrt(square)
            value = added.mean(axis=1) * square / C_FLASH
            value = value * (1 + noise * random.normal(size=value.shape))
            response.append(value * seen)
            weight.append(seen)
            to_light.append(towards / np.sqrt(square)[:, None])
        self.response, self.to_light = np.stack(response), np.stack(to_light)
        self.weight = np.stack(weight).astype(np.float64)
        self.noise, self.reflectance = max(noise, 0.01), replace(GLOSSY, f0=f0)

    @property
    def seen(self):
        """[P] bool, whether a quarter of the frames, or one, sees the point well."""
        cosine = (self.truth * self.to_light).sum(axis=-1)
        return (self.weight * (cosine > 0.4)).sum(axis=0) >= max(1, len(self.weight) // 4)

    def flash(self):
        arrays = (self.response, self.weight, self.to_light, np.ones(COUNT))
        return FlashResponses(*(torch.tensor(array, dtype=torch.float32) for array in arrays), self.noise)

    def cloud(self):
        return tuple(torch.tensor(part, dtype=torch.float32) for part in (self.points, self.cloud_normals))

    def refine(self, config=CONFIG, cloud_noise=0.0005):
        return refine_shape(
            *self.cloud(),
            self.flash(),
            self.reflectance,
            spacing=SPACING_M,
            cloud_noise=cloud_noise,
            config=config,
        )

    def errors(self, shape):
        """Mean errors of the cloud's normals and of a shape's, degrees, where the flash saw them."""
        return tuple(
            degrees(normals, self.truth, self.seen) for normals in (self.cloud_normals, shape.normals_world)
        )


@pytest.fixture(scope="module")
def film():
    return Film()


# Bumps tilt by 6 degrees on the mean. Frames of an arc know tilts along it to 1 % / tan(45 degrees), half a
# degree; those across come from the surface being one.
def test_bumps_that_the_cloud_smoothed_away_come_back(film):
    cloud, shape = film.errors(film.refine())
    assert cloud > 4
    assert shape < 0.35 * cloud


def test_gloss_tells_more_of_them():
    glossy = Film(f0=0.04)
    cloud, shape = glossy.errors(glossy.refine())
    matte = Film()
    assert shape < 0.3 * cloud
    assert shape < 0.9 * matte.errors(matte.refine())[1]


def test_normals_are_unit_and_heights_those_of_the_bumps(film):
    shape = film.refine()
    torch.testing.assert_close(torch.linalg.vector_norm(shape.normals_world, dim=1), torch.ones(COUNT))
    # To first order a bump is as high as f is low, times the radius; the anchor takes some of what is wide.
    bumps = -HEAD.implicit(film.points) * np.linalg.norm(film.points, axis=1)
    correlation = np.corrcoef(shape.heights.numpy()[film.seen], bumps[film.seen])[0, 1]
    assert correlation > 0.8


def test_a_coarse_start_ends_where_long_iterating_on_all_points_does(film):
    plain = film.refine(ShapeConfig(coarse_rounds=0, rounds=4, iterations=200))
    quick = film.refine()
    # Neither is converged to the last: a tenth of their error of 1.2 degrees.
    assert film.errors(quick)[1] < 1.1 * film.errors(plain)[1]


def test_of_one_flash_frame_an_albedo_explains_all():
    single = Film(frames=1)
    cloud, shape = single.errors(single.refine())
    assert shape == pytest.approx(cloud, rel=0.01)


def test_three_flash_frames_tell_a_part():
    # They are 50 degrees apart: half of the points are seen by two of them, and know one number.
    few = Film(frames=3)
    cloud, shape = few.errors(few.refine())
    assert shape < 0.85 * cloud


def test_frames_that_saw_nothing_leave_the_surface_as_it_is(film):
    points, normals = film.cloud()
    flash = film.flash()
    blind = replace(flash, response=torch.zeros_like(flash.response), weight=torch.zeros_like(flash.weight))
    shape = refine_shape(points, normals, blind, GLOSSY, spacing=SPACING_M, cloud_noise=0.0005)
    assert (shape.heights == 0).all()
    torch.testing.assert_close(shape.normals_world, normals)


def test_a_black_subject_stays_as_the_cloud_has_it():
    black = Film(albedo=0.0)
    shape = black.refine()
    torch.testing.assert_close(shape.normals_world, black.cloud()[1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("f0", [0.0, 0.04])
def test_a_perfect_cloud_is_hardly_spoiled(f0):
    perfect = Film(cloud=HEAD, f0=f0)
    cloud, shape = perfect.errors(perfect.refine())
    assert cloud < 1e-3
    # 1 % of noise in five or so frames at 45 degrees: 0.01 / sqrt(5) rad is 0.25 degrees, on the mean of many
    # neighbours less.
    assert shape < 0.3


def test_a_frame_with_a_highlight_or_a_shadow_that_is_not_in_the_model_does_not_dent_the_surface(film):
    spoiled = Film()
    # A patch of 4 cm in one frame, twice as bright, and one in the next that is in shadow.
    bright = np.linalg.norm(spoiled.points - spoiled.points[np.argmax(spoiled.points[:, 2])], axis=1) < 0.02
    spoiled.response[5, bright] *= 2.0
    spoiled.response[6, bright] *= 0.2
    clean = degrees(film.refine().normals_world, film.truth, bright)
    # Followed, the two would tilt it by tens of degrees; robust weights leave hundredths of that.
    assert degrees(spoiled.refine().normals_world, spoiled.truth, bright) < clean + 0.3


def test_what_the_model_cannot_explain_counts_for_less(film):
    # Noise of 30 % at every second centimetre, unlike that of the subject as a whole.
    noisy = Film()
    random = np.random.default_rng(7)
    rough = np.sin(noisy.points @ np.array([0, 300.0, 0])) > 0
    noisy.response[:, rough] *= 1 + 0.3 * random.normal(size=(len(noisy.response), int(rough.sum())))
    cloud = degrees(noisy.cloud_normals, noisy.truth, noisy.seen & rough)
    # Its neighbours carry it.
    assert degrees(noisy.refine().normals_world, noisy.truth, noisy.seen & rough) < 0.5 * cloud


def test_few_points_need_no_coarse_start_and_one_has_no_slope():
    one = torch.tensor([[0.0, 0, 0.1]])
    up = torch.tensor([[0.0, 0, 1.0]])
    light = torch.nn.functional.normalize(torch.tensor([[[0.3, 0, 1.0]], [[-0.3, 0.2, 1.0]]]), dim=-1)
    flash = FlashResponses(torch.tensor([[0.4], [0.3]]), torch.ones(2, 1), light, torch.ones(1), 0.02)
    shape = refine_shape(one, up, flash, GLOSSY, spacing=0.001, cloud_noise=0.0)
    assert shape.heights.isfinite().all()
    torch.testing.assert_close(shape.normals_world, up)


def test_not_a_number_is_made_of_nothing(film):
    flash = film.flash()
    hostile = [
        replace(flash, response=flash.response * 1e6),
        replace(flash, response=-flash.response),
        replace(flash, to_light=-flash.to_light),
        replace(flash, gloss=torch.full((COUNT,), 1e4)),
        replace(flash, noise=0.0),
    ]
    for case in hostile:
        shape = refine_shape(*film.cloud(), case, GLOSSY, spacing=SPACING_M, cloud_noise=0.0)
        assert shape.heights.isfinite().all()
        assert shape.normals_world.isfinite().all()


def test_the_terms_are_the_derivatives_of_the_energy():
    """Against central differences of the misfit with the albedo free, in numpy and float64."""
    film = Film(f0=0.04, noise=0.002)
    some = np.flatnonzero(film.seen)[::400]
    points, normals = (part[some] for part in film.cloud())
    flash = film.flash().of(torch.from_numpy(some))
    field = HeightField(points, normals, SPACING_M)
    slopes = torch.zeros(2, len(some))
    terms = _slope_terms(field, flash, film.reflectance, normals, slopes, CONFIG.slope_sigma)
    arrays = (field.u, field.v, normals, flash.to_light, flash.response, flash.weight)
    u, v, n, light, response, seen = (part.double().numpy() for part in arrays)
    alpha, k = GLOSSY.alpha, GLOSSY.alpha / 2

    def model(along_u, along_v):
        """Diffuse curve and gloss [K, P] at slopes."""
        tilted = n - along_u * u - along_v * v
        tilted = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
        c = np.clip((tilted * light).sum(axis=-1), 0, 1)
        lobe = alpha**2 * c / (4 * (c * (1 - k) + k) ** 2 * (c * c * (alpha**2 - 1) + 1) ** 2)
        return c, 0.04 * lobe

    curve, gloss = model(0.0, 0.0)
    weight = seen * (curve > 0.2) * curve
    # Robust weights and noise belong to the linearisation: they are taken at the normals given.
    robust = weight
    for _ in range(3):
        albedo = (robust * curve * (response - gloss)).sum(axis=0) / (robust * curve**2).sum(axis=0)
        left = response - gloss - albedo * curve
        spread = film.noise * albedo + 0.004
        robust = weight / (1 + (0.5 * left / spread) ** 2)

    def energy(along_u, along_v):
        curve, gloss = model(along_u, along_v)
        best = (precision * curve * (response - gloss)).sum(axis=0) / (precision * curve**2).sum(axis=0)
        return 0.5 * (precision * (response - gloss - best * curve) ** 2).sum(axis=0)

    last = weight / (1 + (0.5 * left / spread) ** 2)
    precision = last / spread**2
    step = 1e-4
    slope_u = (energy(step, 0) - energy(-step, 0)) / (2 * step)
    slope_v = (energy(0, step) - energy(0, -step)) / (2 * step)
    # Terms are those of the energy times how far the point is believed, which is the same in both directions
    # and not above 3 / 2: this many frames without any noise.
    for found, wanted in ((terms.right[0], -slope_u), (terms.right[1], -slope_v)):
        belief = found.double().numpy() / wanted
        sound = np.abs(wanted) > 0.02 * np.abs(wanted).max()
        assert ((belief > 0) & (belief < 1.5))[sound].all()
    ratio_u, ratio_v = terms.right[0].numpy() / -slope_u, terms.right[1].numpy() / -slope_v
    both = (np.abs(slope_u) > 0.02 * np.abs(slope_u).max()) & (np.abs(slope_v) > 0.02 * np.abs(slope_v).max())
    # The albedo of the last robust weights but one makes the residual; differences of 1e-4 in float32 data.
    np.testing.assert_allclose(ratio_u[both], ratio_v[both], rtol=0.05)


def test_a_solve_with_it_has_better_normals_than_one_without():
    head = Head(bump=0.015)
    frames = [photograph(head, camera) for camera in arc(count=18, size=80)]
    pictures = [with_noise(frame.radiance, 0.01, k) for k, frame in enumerate(frames)]
    # Noise of 2 mm: the cloud must be smoothed over centimetres.
    scene = MemoryScene(frames, pictures, torch.from_numpy(cloud_of(head, 5000, 0.002)[0]))
    errors = []
    for shape in (None, CONFIG):
        portrait = solve(scene, SolveConfig(cloud=CloudConfig(max_points=6000), shape=shape))
        known = portrait.confidence.numpy() > 0.6
        truth = head.normals(portrait.points.double().numpy()[known])
        errors.append(degrees(portrait.normals_world.numpy()[known], truth))
    assert errors[1] < 0.8 * errors[0]
