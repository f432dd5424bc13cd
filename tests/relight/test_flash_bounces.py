"""Light of the flash by way of other parts against form factors summed plainly, in a corner and on a ball."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from analytic_scene import (
    C_FLASH,
    FLASH_OFFSET_CAM_M,
    Frame,
    MemoryScene,
    looking_at,
    sphere_portrait,
    with_noise,
)

from relight.cloud import CloudConfig
from relight.flash_bounces import FlashBounces, flash_bounces
from relight.flash_part import FlashPart
from relight.measured import Measured
from relight.observations import Observations
from relight.photometric import SolveConfig, solve
from relight.reflectance import Reflectance

USUAL_SCALE = 0.75  # what is assumed where nothing tells
SIDE_M, SPACING_M = 0.1, 0.004
RED_FLOOR, RED_WALL = (0.6, 0.4, 0.28), (0.56, 0.3, 0.24)
LAMPS = np.array(
    [[0.5, 0.05, 0.08], [0.4, 0.2, 0.25], [0.35, 0.05, 0.35], [0.25, -0.1, 0.4], [0.08, 0.05, 0.5]]
)


@dataclass(frozen=True)
class Subject:
    """Points with normals and albedo, [P, 3] each, float64."""

    points: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    spacing: float = SPACING_M


def corner(floor=RED_FLOOR, wall=RED_WALL):
    """A floor at z = 0 that faces up and a wall at x = 0 that faces +x; floor first."""
    steps = np.arange(SPACING_M / 2, SIDE_M, SPACING_M)
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    zero = np.zeros_like(a)
    points = np.concatenate([np.stack([a, b, zero], axis=1), np.stack([zero, b, a], axis=1)])
    normals = np.repeat([[0.0, 0, 1], [1.0, 0, 0]], len(a), axis=0)
    return Subject(points, normals, np.repeat([floor, wall], len(a), axis=0).astype(float))


@cache
def form_factors(pieces=4):
    """[P, P] of the corner: cos cos / (pi r^2) dA, from each point to the others' squares in small pieces."""
    subject = corner()
    offsets = (np.arange(pieces) - (pieces - 1) / 2) * SPACING_M / pieces
    across = subject.normals[:, ::-1]  # with y the axes of each square
    result = np.zeros((len(subject.points), len(subject.points)))
    for u, v in ((u, v) for u in offsets for v in offsets):
        towards = subject.points + u * across + [0.0, v, 0.0] - subject.points[:, None]
        square = np.maximum((towards**2).sum(axis=-1), 1e-12)
        here = np.einsum("ijk,ik->ij", towards, subject.normals)
        there = -np.einsum("ijk,jk->ij", towards, subject.normals)
        result += here.clip(0) * there.clip(0) / (np.pi * square**2) * (SPACING_M / pieces) ** 2
    return result


def under_lamps(subject, lamps=LAMPS, aim=None, falloff=0.0):
    """Cosine [K, P], squared distance [K, P], share of the beam [K, P] and directions [K, P, 3] to lamps."""
    towards = lamps[:, None] - subject.points
    square = (towards**2).sum(axis=-1)
    to_light = towards / np.sqrt(square)[..., None]
    share = np.ones_like(square)
    if falloff:
        share = (-(to_light * aim[:, None]).sum(axis=-1)) ** falloff
    return np.clip((to_light * subject.normals).sum(axis=-1), 0, None), square, share, to_light


def light_of_others(subject, **lit):
    """J [K, P, 3], all bounces: (1 - F A) B = F A E solved per channel, over what faces the flash gets."""
    cosine, square, share, _ = under_lamps(subject, **lit)
    factors, direct = form_factors(), share * cosine / square
    result = np.empty((*cosine.shape, 3))
    for c in range(3):
        carried = factors * subject.albedo[:, c]
        arriving = np.linalg.solve(np.eye(len(carried)) - carried, carried @ direct.T)
        result[..., c] = arriving.T / share * square
    return result


def tensor(values):
    return torch.from_numpy(np.asarray(values, np.float32))


def seen(subject, light=0.0, reflectance=None, relative=0.02, **lit):
    """What is measured of the subject where others send some light [K, P, 3]."""
    reflectance = Reflectance() if reflectance is None else reflectance
    cosine, _, _, to_light = under_lamps(subject, **lit)
    cosine = tensor(cosine)
    diffuse, gloss = (part(cosine).numpy()[..., None] for part in (reflectance.diffuse, reflectance.gloss))
    response = subject.albedo * (diffuse + light) + gloss
    count = len(subject.points)
    flash = FlashPart(tensor(response), (cosine > 0).float(), tensor(to_light), torch.ones(count))
    on_subject = torch.ones(count, dtype=torch.bool)
    return Measured(on_subject, flash, 1.0, torch.ones(len(cosine)), reflectance, relative)


def observed(lamps=LAMPS, aim=None, falloff=0.0):
    """Frames with flashes, and one without before each, which is elsewhere."""
    places, axes = (np.repeat(values, 2, axis=0) for values in (lamps, lamps if aim is None else aim))
    places[::2] = -7.0
    nothing = torch.zeros(len(places), 0)
    return Observations(
        radiance=nothing[..., None],
        cosine=nothing,
        flash=torch.arange(len(places)) % 2 == 1,
        flash_position_world=tensor(places),
        view_direction_world=tensor(places),
        outside=nothing[0],
        flash_axis_world=tensor(axes),
        flash_falloff=falloff,
    )


def as_fitted(measured, normals):
    """The albedo [P, 3] that a fit without bounces gives: plain least squares."""
    flash = measured.flash
    cosine = (flash.to_light * tensor(normals)).sum(dim=-1)
    diffuse = (measured.reflectance.diffuse(cosine) * flash.weight)[..., None]
    matte = flash.response - (measured.reflectance.gloss(cosine) * flash.gloss)[..., None]
    return (diffuse * matte).sum(dim=0) / (diffuse**2).sum(dim=0).clamp(min=1e-9)


def found(subject, measured, gauge=1.0, known=None, observations=None, albedo=None):
    """Of the subject with the albedo that a fit gives, which is taken for `gauge` times as bright."""
    known = torch.ones(len(subject.points), dtype=torch.bool) if known is None else known
    return flash_bounces(
        tensor(subject.points),
        tensor(subject.normals),
        subject.spacing,
        as_fitted(measured, subject.normals) if albedo is None else tensor(albedo),
        gauge,
        known,
        measured,
        observed() if observations is None else observations,
    )


@pytest.fixture(scope="module")
def light():
    """J in the corner, [K, P, 3]."""
    return light_of_others(corner())


@pytest.mark.parametrize("gauge", [1.0, 1.6])
def test_the_light_and_its_scale_are_found_however_bright_the_albedo_is_taken(light, gauge):
    subject = corner()
    bounces = found(subject, seen(subject, light), gauge)
    # Surfels beside the fold do not see what is nearer than themselves, and what bounced there remains in
    # their albedo, which by so much needs less of a scale.
    assert bounces.scale == pytest.approx(1.0 / gauge, rel=0.15)
    away = subject.points[:, [0, 2]].sum(axis=1) > 2 * SPACING_M
    ratio = (bounces.light.numpy() / light)[:, away]
    # 128 directions hit a wall that fills a tenth of the sky to about a tenth of it.
    assert ratio.mean() == pytest.approx(1.0, abs=0.16)  # by the scale, see above
    assert ratio.std() < 0.12


@pytest.mark.parametrize("share", [0.0, 0.05, 0.1, 0.2, 0.5, 0.8])
def test_the_scale_is_what_the_frames_show_and_near_nothing_where_nothing_bounced(light, share):
    subject = corner()
    # As above, and 0.02 for what is usual, which a contrast of some hundredths outweighs by far.
    bounces = found(subject, seen(subject, share * light))
    assert bounces.scale == pytest.approx(share, abs=0.02 + 0.08 * share)


def test_a_bounce_beyond_what_albedos_allow_is_not_believed(light):
    subject = corner()
    assert found(subject, seen(subject, 3.0 * light)).scale == 1.25


def test_what_makes_all_channels_brighter_alike_does_not_matter(light):
    subject = corner()
    measured = seen(subject, light)
    expected = found(subject, measured).scale
    random = np.random.default_rng(0)
    # Of every point in every frame by itself, far more than poses and gains err by.
    factor = tensor(1.0 + 0.1 * random.normal(size=light.shape[:2]))[..., None]
    brighter = replace(measured, flash=replace(measured.flash, response=factor * measured.flash.response))
    assert found(subject, brighter).scale == pytest.approx(expected, abs=0.02)
    tilted = subject.normals + 0.1 * random.normal(size=subject.normals.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    # Normals that are off by 8 degrees (rms) also send the light elsewhere.
    assert found(replace(subject, normals=tilted), measured).scale == pytest.approx(expected, abs=0.06)


def test_gloss_and_grazing_light_are_not_taken_for_a_bounce(light):
    subject, reflectance = corner(), Reflectance(retro=0.5, alpha=0.25, f0=0.04)
    expected = found(subject, seen(subject, light)).scale
    assert found(subject, seen(subject, light, reflectance)).scale == pytest.approx(expected, abs=0.02)


def test_a_narrow_flash_lights_what_bounces_as_it_lights_what_it_is_aimed_at(light):
    subject = corner()
    aim = np.array([0.15, -0.2, 0.1]) - LAMPS / np.linalg.norm(LAMPS, axis=1, keepdims=True)
    beam = {"aim": aim / np.linalg.norm(aim, axis=1, keepdims=True), "falloff": 4.0}
    narrow = light_of_others(subject, **beam)
    assert np.abs(narrow / light - 1.0).max() > 0.3  # it matters
    bounces = found(subject, seen(subject, narrow, **beam), observations=observed(**beam))
    wide = found(subject, seen(subject, light))
    assert bounces.scale == pytest.approx(1.0, abs=0.15)
    # What the transport errs by is the same for both.
    ratio = (bounces.light / wide.light).numpy() * wide.scale / bounces.scale
    np.testing.assert_allclose(ratio, narrow / light, rtol=0.08)


def test_many_frames_are_as_few():
    subject = corner()
    many = {"lamps": np.tile(LAMPS, (3, 1))}
    light = light_of_others(subject)
    few = found(subject, seen(subject, light))
    bounces = found(subject, seen(subject, np.tile(light, (3, 1, 1)), **many), observations=observed(**many))
    # Of many, some tell the scale; light goes with it, and a little faster, for it bounces more than once.
    assert bounces.scale == pytest.approx(few.scale, rel=0.03)
    torch.testing.assert_close(bounces.light, few.light.repeat(3, 1, 1), rtol=0.05, atol=1e-6)


@pytest.mark.parametrize("gauge", [1.0, 1.6])
def test_a_subject_without_colour_has_the_usual_scale(gauge):
    grey = corner((0.5, 0.5, 0.5), (0.3, 0.3, 0.3))
    bounces = found(grey, seen(grey, light_of_others(grey)), gauge)
    assert bounces.scale == pytest.approx(USUAL_SCALE, abs=1e-4)
    assert (bounces.light > 0).any()


def test_one_flash_has_the_usual_scale_for_its_albedo_explains_everything():
    subject, one = corner(), {"lamps": LAMPS[2:3]}
    light = light_of_others(subject, **one)
    bounces = found(subject, seen(subject, light, **one), observations=observed(**one))
    assert bounces.scale == pytest.approx(USUAL_SCALE, abs=1e-4)
    assert bounces.light.isfinite().all()


def test_a_ball_sends_itself_nothing():
    ball = sphere_portrait(3000)
    points, normals = ball.points.double().numpy(), ball.normals_world.double().numpy()
    subject = Subject(points, normals, np.tile(RED_FLOOR, (len(points), 1)), ball.spacing)
    assert found(subject, seen(subject)).light.max() < 0.01


def test_points_without_a_known_albedo_send_what_the_usual_one_does(light):
    subject = corner()
    floor = np.arange(len(subject.points)) < len(subject.points) // 2
    known = torch.from_numpy(floor | (subject.points[:, 2] > 0.07))
    wrong = replace(subject, albedo=np.where(known[:, None], subject.albedo, 7.0))
    usual = replace(subject, albedo=np.where(known[:, None], subject.albedo, RED_FLOOR))
    measured = seen(subject, light)
    torch.testing.assert_close(
        found(wrong, measured, known=known, albedo=wrong.albedo).light,
        found(usual, measured, known=known, albedo=usual.albedo).light,
    )


def unlit(measured):
    return replace(measured, flash=replace(measured.flash, weight=torch.zeros_like(measured.flash.weight)))


@pytest.mark.parametrize(
    ("subject", "change"),
    [(corner(), unlit), (corner((0, 0, 0), (0, 0, 0)), lambda measured: measured)],
    ids=["nothing is seen", "black"],
)
def test_what_tells_nothing_has_the_usual_scale(subject, change):
    bounces = found(subject, change(seen(subject)))
    assert bounces.scale == pytest.approx(USUAL_SCALE, abs=1e-6)
    assert bounces.light.isfinite().all()


def test_one_known_point_is_enough_to_be_finite(light):
    subject = corner()
    known = torch.arange(len(subject.points)) == 7
    bounces = found(subject, seen(subject, light), known=known)
    assert 0.0 < bounces.scale <= 1.25
    assert bounces.light.isfinite().all()


def test_flashes_behind_the_surface_throw_nothing():
    subject, behind = corner(), {"lamps": np.array([[-0.5, 0.05, -0.5], [-0.3, 0.0, -0.6]])}
    bounces = found(subject, seen(subject, **behind), observations=observed(**behind))
    assert not bounces.light.any()


def test_the_excess_is_that_of_a_plain_least_squares():
    random = np.random.default_rng(3)
    light, weight, diffuse = random.random((4, 5, 3)), random.random((4, 5)), random.random((4, 5))
    weight[:, 4] = 0.0  # never seen
    excess = FlashBounces(tensor(light), 1.0).excess(tensor(weight), tensor(diffuse)).numpy()
    for p in range(4):
        root = np.sqrt(weight[:, p])
        fitted = np.linalg.lstsq((root * diffuse[:, p])[:, None], root[:, None] * light[:, p], rcond=None)[0]
        np.testing.assert_allclose(excess[p], fitted[0], rtol=1e-5)
    np.testing.assert_array_equal(excess[4], 0.0)


# A bowl of a sphere: its parts all see each other alike, so that what bounces is the same everywhere.
RADIUS_M, HALF_RAD = 0.08, np.radians(70)


def bowl(count=4000):
    """Unit directions [count, 3] from the middle of the sphere to points of the bowl, which opens to +z."""
    z = 1.0 - (1.0 - np.cos(HALF_RAD)) * (np.arange(count) + 0.5) / count
    ring, phi = np.sqrt(1.0 - z * z), np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return -np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)


def bowl_albedo(directions):
    return np.array(RED_FLOOR) * (1.0 + 0.15 * np.sin(directions @ [9.0, 5.0, 3.0]))[..., None]


def straight(directions, lamp):
    """cos / d^2 [...] at points of the bowl in directions [..., 3]."""
    towards = lamp - RADIUS_M * directions
    return -(towards * directions).sum(axis=-1).clip(max=0) / (towards**2).sum(axis=-1) ** 1.5


def bounced(lamp):
    """[3] of a white surface anywhere in the bowl: E = share mean(A (E + straight)), the form factor between
    any two parts of a sphere being that of their area in it."""
    directions, share = bowl(), (1.0 - np.cos(HALF_RAD)) / 2.0
    albedo = bowl_albedo(directions)
    sent = (albedo * straight(directions, lamp)[:, None]).mean(axis=0)
    return share * sent / (1.0 - share * albedo.mean(axis=0))


def lamp_of(camera):
    return camera.centre_world + camera.cam_from_world[:3, :3].T @ FLASH_OFFSET_CAM_M


def film_of_bowl(size=96):
    """24 frames from before it, every other one with the flash."""
    frames = []
    for k in range(24):
        across, up = np.radians([-35.0 + 14.0 * (k % 6), -35.0 + 70.0 / 3.0 * (k // 6)])
        eye = 0.4 * np.array([np.sin(across), np.sin(up), np.cos(across) * np.cos(up)])
        camera = looking_at(eye, np.array([0, 0, -0.05]), size=size, flash=(k + k // 6) % 2)
        v, u = np.mgrid[0:size, 0:size] + 0.5
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
        rays = rays @ camera.cam_from_world[:3, :3]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        along = rays @ eye
        root = along**2 - (eye @ eye - RADIUS_M**2)
        points = eye + (np.sqrt(root.clip(0)) - along)[..., None] * rays  # the far side of the sphere
        directions = points / RADIUS_M
        hit = (root > 0) & (directions[..., 2] < -np.cos(HALF_RAD))
        albedo, lamp = bowl_albedo(directions), lamp_of(camera)
        lit = straight(directions, lamp)[..., None] + bounced(lamp)
        radiance = albedo * (0.1 + camera.flash * C_FLASH * lit)
        maps = (np.where(hit[..., None], values, 0.0) for values in (points, -directions, albedo, radiance))
        frames.append(Frame(camera, hit, *maps))
    return frames


@pytest.fixture(scope="module")
def bowl_scene():
    """With noise of 1 %."""
    frames = film_of_bowl()
    radiances = [with_noise(frame.radiance, 0.01, k, floor=0.0) for k, frame in enumerate(frames)]
    return MemoryScene(frames, radiances, tensor(RADIUS_M * bowl()), tensor(-bowl()))


class BowlErrors:
    """What a solve with or without bounces gets wrong, but at the rim."""

    def __init__(self, scene, bounces):
        config = SolveConfig(cloud=CloudConfig(max_points=4000), mirror=False, bounces=bounces)
        self.portrait = solve(scene, config)
        directions = torch.nn.functional.normalize(self.portrait.points.double(), dim=1).numpy()
        self.used = directions[:, 2] < -np.cos(HALF_RAD - 0.15)
        self.directions = directions[self.used]
        self.scaled = self.portrait.c_flash[0] / C_FLASH * self.portrait.albedo.numpy()[self.used]
        self.albedo = self.scaled / bowl_albedo(self.directions) - 1.0  # no scale is left to choose
        cosine = -(self.directions * self.portrait.normals_world.numpy()[self.used]).sum(axis=1)
        self.normals_rad = np.arccos(cosine.clip(-1, 1))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_solve_that_knows_of_bounces_finds_a_bowl_s_albedo_and_normals(bowl_scene):
    told, untold = BowlErrors(bowl_scene, True), BowlErrors(bowl_scene, False)
    # The flash makes the bowl a tenth brighter in blue and a fifth in red. What is left is the error of J
    # there, a tenth.
    assert rms(untold.albedo) > 0.12
    assert rms(told.albedo) < 0.02
    # Noise of 1 % in ten frames or so is some 0.3 degrees; flattening is more.
    assert np.degrees(rms(told.normals_rad)) < 0.7
    assert rms(told.normals_rad) < 0.7 * rms(untold.normals_rad)
    # Without, light that comes everywhere looks like a surface bright at grazing angles; it has none.
    assert told.portrait.reflectance.retro == 0.0 < untold.portrait.reflectance.retro
    assert not untold.portrait.flash_bounce.any()
    assert untold.portrait.bounce_scale == 1.0


def test_what_was_taken_off_comes_back_with_the_flash(bowl_scene):
    told = BowlErrors(bowl_scene, True)
    portrait, shown, bare = told.portrait, [], []
    bounce = portrait.flash_bounce.numpy()[told.used, None]
    albedo = portrait.albedo.numpy()[told.used]
    for frame in bowl_scene.frames:
        if frame.camera.flash:
            lamp = lamp_of(frame.camera)
            direct = straight(told.directions, lamp)[:, None]
            truth = bowl_albedo(told.directions) * (direct + bounced(lamp))
            shown.append((told.scaled * (1.0 + bounce * albedo) * direct - truth) / truth.mean())
            bare.append((told.scaled * direct - truth) / truth.mean())
    # One number a point stands for all frames, in the sense of least squares; at the rim some see it slanted.
    assert rms(shown) < 0.08
    assert rms(shown) < 0.5 * rms(bare)
