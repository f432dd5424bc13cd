"""Solves of an analytic subject: the truth within what the noise predicts, and scenes that have no answer."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic_scene import (
    C_FLASH,
    PORTRAIT_TENSORS,
    Head,
    MemoryScene,
    arc,
    cloud_of,
    expose,
    looking_at,
    photograph,
    with_noise,
)

from relight.cloud import CloudConfig
from relight.errors import PlanError
from relight.photometric import ALBEDO_95, SolveConfig, solve
from relight.portrait import Portrait

SIZE = 96  # pixels; the subject is some 80 of them high, 2.6 mm each
HEAD = Head()
CAMERAS = arc(size=SIZE)  # 36 views, 12 of them with the flash
LIT = [k for k, camera in enumerate(CAMERAS) if camera.flash]
DARK = [k for k, camera in enumerate(CAMERAS) if not camera.flash]
CLOUD_NOISE_M = 0.0004
CONFIG = SolveConfig(cloud=CloudConfig(max_points=4000))


def film(head, frames, gains=None):
    return [expose(head, frame, 1.0 if gains is None else gains[k]) for k, frame in enumerate(frames)]


def noisy(frames, relative=0.01, seed=0):
    return [with_noise(frame.radiance, relative, 1000 * seed + k) for k, frame in enumerate(frames)]


@pytest.fixture(scope="module")
def frames():
    return [photograph(HEAD, camera) for camera in CAMERAS]


@pytest.fixture(scope="module")
def cloud():
    return torch.from_numpy(cloud_of(HEAD, 5000, CLOUD_NOISE_M)[0])


@pytest.fixture(scope="module")
def portrait(frames, cloud):
    """Of frames with 1 % noise."""
    return solve(MemoryScene(frames, noisy(frames), cloud), CONFIG)


class Errors:
    """What a portrait gets wrong, at the points that the flash observed well."""

    def __init__(self, portrait, head=HEAD):
        self.known = portrait.confidence.numpy() > 0.6
        points = portrait.points.double().numpy()[self.known]
        normals = head.normals(points)
        self.normals_rad = np.arccos(
            np.clip((normals * portrait.normals_world.numpy()[self.known]).sum(axis=1), -1, 1)
        )
        # Only albedo * C is observable: this has no scale left to choose.
        self.product = (
            portrait.albedo.numpy()[self.known] * portrait.c_flash / (C_FLASH * head.albedo(points)) - 1
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            room = head.albedo(points) * head.room(normals)
            self.room = portrait.room_radiance.numpy()[self.known] / room - 1


def spread(values):
    """Standard deviation of the middle of a distribution."""
    return float(np.median(np.abs(values)) / 0.6745)


def assert_finite(portrait):
    for name in PORTRAIT_TENSORS:
        assert getattr(portrait, name).isfinite().all(), name
    numbers = [portrait.spacing, *portrait.c_room, *portrait.c_flash, *vars(portrait.reflectance).values()]
    assert np.isfinite(numbers).all()
    assert (portrait.albedo >= 0).all()
    assert (portrait.room_radiance >= 0).all()
    np.testing.assert_allclose(torch.linalg.vector_norm(portrait.normals_world, dim=1), 1.0, atol=1e-4)
    assert ((portrait.shading >= 0) & (portrait.shading <= 1)).all()
    assert ((portrait.confidence >= 0) & (portrait.confidence < 1)).all()


# Left without noise: bilinear sampling of 2.6 mm pixels and a surface that is 0.2 mm off, 0.5 to 0.8 %.
def test_truth_is_recovered_up_to_the_noise(portrait):
    errors = Errors(portrait)
    assert errors.known.mean() > 0.4  # the arc lights one half of the head
    # Flash frames have noise of 1 % and 0.002 on radiances about 0.4; five of them see a point. That is 0.7 %
    # a channel, the normals' error of 1 degree at 45 degrees adds 1 %, and the rest 0.8 %.
    assert abs(np.median(errors.product)) < 0.01
    assert spread(errors.product) < 0.02
    # Room: 10 to 15 frames of 1 % and 0.002 on radiances about 0.1: 3 % / sqrt(12).
    assert abs(np.median(errors.room)) < 0.005
    assert spread(errors.room) < 0.012
    # Geometric normals alone err by 0.8 degrees (see the tests of the cloud); photometry must not spoil them.
    assert np.degrees(np.sqrt(np.mean(errors.normals_rad**2))) < 1.2
    assert_finite(portrait)


def test_noise_makes_the_error_that_it_predicts(frames, cloud):
    # Two solves of other noise on the same points: their difference is noise alone, without the surface.
    a, b = (solve(MemoryScene(frames, noisy(frames, 0.05, seed), cloud), CONFIG) for seed in (1, 2))
    known = (a.confidence > 0.6) & (b.confidence > 0.6)
    difference = (a.albedo * a.c_flash[0] - b.albedo * b.c_flash[0]).mean(dim=1)[known] / 2**0.5
    predicted = 0.5 * (a.albedo_sigma + b.albedo_sigma)[known] * a.c_flash[0]
    # The prediction is rough (tan^2 = 0.5 on the average, weights for variances) and has the geometric
    # normals' share in it, which the difference has not: it is not below the truth, nor twice as much.
    assert 0.4 < spread((difference / predicted).numpy()) < 1.2


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_standard_errors_are_those_of_the_errors(frames, cloud, noise):
    portrait = solve(MemoryScene(frames, noisy(frames, noise), cloud), CONFIG)
    errors = Errors(portrait)
    known = torch.from_numpy(errors.known)
    albedo_ratio = (
        errors.product.mean(axis=1) / (portrait.albedo_sigma / portrait.albedo.mean(dim=1))[known].numpy()
    )
    # Errors of a surface and of interpolation are no noise; the estimates may be a third off either way. What
    # the model leaves on a real subject is common to frames from one side; this one has noise alone, which is
    # then overstated by the root of their number, about 1.5; and for all that the points can know, its bumps
    # may have been rounded, which they were not: by another two without noise.
    assert 0.3 < spread(albedo_ratio) < 1.6
    # The angle of two components, each with the standard error: rms sqrt(2). The prior of 0.06 rad is wider
    # than this cloud deserves, so the ratio may be well below it, but not above.
    normal_ratio = errors.normals_rad / portrait.normal_sigma_rad[known].numpy()
    assert 0.4 < np.sqrt(np.mean(normal_ratio**2)) < 2.0


def test_normals_are_better_than_the_cloud_s_where_the_flashes_span(frames):
    rough = torch.from_numpy(cloud_of(HEAD, 5000, 0.0015)[0])  # normals of about 2 degrees
    scene = MemoryScene(frames, noisy(frames), rough)
    rms = []
    for sigma_rad in (CONFIG.normal_sigma_rad, 1e-6):
        portrait = solve(scene, replace(CONFIG, normal_sigma_rad=sigma_rad))
        truth = HEAD.normals(portrait.points.double().numpy())
        sideways = np.cross([0.0, 1.0, 0.0], truth)
        sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
        error = ((portrait.normals_world.numpy() - truth) * sideways).sum(axis=1)
        rms.append(spread(error[(portrait.confidence > 0.6).numpy()]))
    # The flashes stand on an arc: sideways they know a normal to the relative noise (2 % with such a cloud)
    # over tan 45 degrees and the root of five frames, one degree; up and down they know little.
    assert rms[0] < 0.7 * rms[1]


def test_scale_of_the_albedo_is_the_convention(portrait):
    known = portrait.confidence > 0.5  # information above `known`
    top = torch.quantile(portrait.albedo[known].mean(dim=1), 0.95)
    assert top.item() == pytest.approx(ALBEDO_95, rel=1e-4)


def test_room_is_split_into_colour_and_shading(portrait):
    # A grey shading explains a room of two colours nearly: its wall has 0.08 to 0.03 of the window's 0.25.
    modelled = portrait.albedo * torch.tensor(portrait.c_room) * portrait.shading[:, None]
    known = portrait.confidence > 0.6
    relative = (modelled - portrait.room_radiance)[known] / portrait.room_radiance[known]
    assert relative.abs().median() < 0.1
    assert torch.quantile(portrait.shading[known], 0.99).item() == pytest.approx(1.0, abs=0.02)


def test_points_that_no_flash_reached_are_filled_and_say_so(portrait):
    unseen = portrait.confidence == 0
    assert 0.1 < unseen.float().mean() < 0.6
    assert (portrait.albedo[unseen].mean(dim=1) > 0.1).all()
    assert (portrait.albedo_sigma[unseen] > portrait.albedo_sigma[~unseen].median()).all()


@pytest.mark.parametrize("spread_of_gains", ["droop", "jitter"])
def test_gains_of_the_flashes_are_found(frames, cloud, spread_of_gains):
    number = np.arange(len(CAMERAS))
    gains = (
        1.1 - 0.2 * number / len(CAMERAS) if spread_of_gains == "droop" else 1 + 0.15 * np.sin(1.7 * number)
    )
    frames = film(HEAD, frames, gains)
    portrait = solve(MemoryScene(frames, noisy(frames), cloud), CONFIG)
    found = np.array(portrait.info["flash_gains"])
    ratio = found / gains[LIT]
    # Each gain is a median over a thousand points: 0.1 %. Five of twelve frames see a point: gains are known
    # against their neighbours', and of a drift of 20 % over the arc 2 % are left when the steps end.
    np.testing.assert_allclose(ratio / np.median(ratio), 1.0, atol=0.02)
    assert spread(Errors(portrait).product - np.median(Errors(portrait).product)) < 0.02


def test_gloss_is_not_taken_for_albedo(frames, cloud):
    head = Head(retro=0.5, alpha=0.25, f0=0.04)
    frames = film(head, frames)
    scene = MemoryScene(frames, noisy(frames), cloud)
    portrait = solve(scene, CONFIG)
    matte = solve(scene, replace(CONFIG, fit_gloss=False))
    # Steps of an eighth of the grid's, among which noise and normals choose.
    assert portrait.reflectance.alpha == pytest.approx(head.alpha, rel=0.06)
    assert portrait.reflectance.retro == pytest.approx(head.retro, abs=0.1)
    # In the same units as the albedo; the lobe's foot is alike to albedo, which leaves a fifth undecided.
    assert portrait.reflectance.f0 * portrait.c_flash[0] == pytest.approx(head.f0 * C_FLASH, rel=0.2)
    assert spread(Errors(portrait, head).product) < 0.02
    assert spread(Errors(portrait, head).product) < 0.5 * spread(Errors(matte, head).product)


@pytest.mark.parametrize("kind", ["flash", "no-flash"])
def test_a_tenth_of_the_pixels_wrong_does_not_matter_much(frames, cloud, portrait, kind):
    random = np.random.default_rng(0)
    radiances = noisy(frames)
    for k in LIT if kind == "flash" else DARK:
        blocks = np.kron(random.random((SIZE // 8, SIZE // 8)) < 0.1, np.ones((8, 8))) > 0
        radiances[k][blocks] = random.uniform(0, 0.9, 3)
    errors = Errors(solve(MemoryScene(frames, radiances, cloud), CONFIG))
    clean = Errors(portrait)
    # Of five frames that see a point, at most one or two are wrong and lose their weight: what is left has up
    # to sqrt(5 / 3) the error, and the wrong ones keep a few per cent of their weight.
    assert spread(errors.product) < 2 * spread(clean.product)
    assert abs(np.median(errors.product)) < 0.015
    assert spread(errors.room) < 2 * spread(clean.room)
    assert np.median(errors.normals_rad) < 1.5 * np.median(clean.normals_rad)


def test_duplicate_frames_change_nothing_but_confidence(frames, cloud, portrait):
    twice = [k for k in range(len(frames)) for _ in range(2)]
    radiances = noisy(frames)
    doubled = solve(MemoryScene([frames[k] for k in twice], [radiances[k] for k in twice], cloud), CONFIG)
    assert (doubled.confidence >= portrait.confidence).all()
    known = portrait.confidence > 0.6
    ratio = (doubled.albedo * doubled.c_flash[0])[known] / (portrait.albedo * portrait.c_flash[0])[known]
    # The prior of the normal counts half as much: its share of the error changes, which is below a per cent.
    assert spread(ratio.numpy() - 1) < 0.01


def test_the_same_scene_gives_the_same_portrait(frames, cloud, portrait):
    again = solve(MemoryScene(frames, noisy(frames), cloud), CONFIG)
    for field in fields(Portrait):
        if field.name in PORTRAIT_TENSORS:
            np.testing.assert_array_equal(getattr(again, field.name), getattr(portrait, field.name))
        else:
            assert getattr(again, field.name) == getattr(portrait, field.name)


def test_unit_of_length_does_not_matter(frames, cloud, portrait):
    def in_millimetres(frame):
        pose = frame.camera.cam_from_world.copy()
        pose[:3, 3] *= 1000
        return replace(frame, camera=replace(frame.camera, cam_from_world=pose))

    scene = MemoryScene([in_millimetres(frame) for frame in frames], noisy(frames), 1000 * cloud)
    scene.flash_offset_cam_m = 1000 * scene.flash_offset_cam_m
    larger = solve(scene, CONFIG)
    # c_flash is radiance at a distance of one unit. Rounding may move a few points to other places.
    assert larger.c_flash[0] == pytest.approx(1e6 * portrait.c_flash[0], rel=0.01)
    assert larger.spacing == pytest.approx(1000 * portrait.spacing, rel=1e-3)
    assert np.median(larger.albedo) == pytest.approx(np.median(portrait.albedo), rel=0.01)


def test_progress_ends_at_one(frames, cloud):
    told = {}
    solve(
        MemoryScene(frames[:6], noisy(frames)[:6], cloud),
        CONFIG,
        lambda stage, share: told.update({stage: share}),
    )
    assert told == {"cloud": 1.0, "observe": 1.0, "solve": 1.0}


def test_a_dark_room_has_no_shading(frames, cloud):
    head = Head(room_gain=0.0)
    frames = film(head, frames)
    portrait = solve(MemoryScene(frames, noisy(frames), cloud), CONFIG)
    assert_finite(portrait)
    assert max(portrait.c_room) < 0.01  # noise of 0.002 is all there is
    assert spread(Errors(portrait, head).product) < 0.02


def test_a_room_without_noise_and_light_is_black(frames, cloud):
    head = Head(room_gain=0.0)
    frames = film(head, frames)
    portrait = solve(MemoryScene(frames, [frame.radiance for frame in frames], cloud), CONFIG)
    assert portrait.c_room == (0.0, 0.0, 0.0)
    assert not portrait.shading.any()
    assert_finite(portrait)


@pytest.mark.parametrize("chosen", [[*DARK, LIT[6]], [DARK[12], LIT[6]]], ids=["one flash", "two frames"])
def test_few_frames_are_enough_where_they_look(frames, cloud, chosen):
    radiances = noisy(frames)
    scene = MemoryScene([frames[k] for k in chosen], [radiances[k] for k in chosen], cloud)
    portrait = solve(scene, CONFIG)
    assert_finite(portrait)
    errors = Errors(portrait)
    assert errors.known.mean() > 0.05
    # One frame of 1 % and 0.002: the geometric normal's degree at up to 45 degrees adds as much again.
    assert spread(errors.product) < 0.04
    # One frame has no spread of its own: the error is that of the subject, not zero.
    assert (portrait.albedo_sigma > 0).all()


def test_masks_carve_what_is_not_the_subject(frames, cloud):
    other = cloud[: len(cloud) // 2] + torch.tensor([0.35, 0.0, 0.0])  # in the picture, off the masks
    portrait = solve(MemoryScene(frames, noisy(frames), torch.cat([cloud, other])), CONFIG)
    assert (portrait.points[:, 0] < 0.15).all()


def test_points_that_no_frame_sees_are_finite(frames, cloud):
    hidden = 0.5 * cloud  # a head within the head
    portrait = solve(MemoryScene(frames, noisy(frames), torch.cat([cloud, hidden])), CONFIG)
    assert_finite(portrait)


def unchanged(frames):
    return frames


def flagged(flash):
    return lambda frames: [replace(f, camera=replace(f.camera, flash=flash)) for f in frames]


def turned_away(frames):
    cameras = (f.camera for f in frames)
    away = [looking_at(c.centre_world, 2 * c.centre_world, size=SIZE, flash=c.flash) for c in cameras]
    return [replace(frame, camera=camera) for frame, camera in zip(frames, away, strict=True)]


def clipped(which):
    return lambda radiances: [np.ones_like(r) if k in which else r for k, r in enumerate(radiances)]


@pytest.mark.parametrize(
    ("change_frames", "change_radiances", "word"),
    [
        (flagged(0), unchanged, "no flash frames"),
        (flagged(1), unchanged, "no no-flash frames"),
        (turned_away, unchanged, "No camera has the cloud before it"),
        (unchanged, clipped(range(36)), "No frame shows a point"),
        (unchanged, clipped(LIT), "do not light any point"),
        (unchanged, clipped(DARK), "do not light any point"),
        (unchanged, lambda radiances: [np.full_like(r, np.nan) for r in radiances], "No frame shows a point"),
        (lambda frames: film(Head(albedo_gain=0.0), frames), None, "no brighter than the others"),
        (lambda frames: film(HEAD, frames, np.zeros(36)), None, "no brighter than the others"),
    ],
    ids=[
        "never flash",
        "always flash",
        "turned away",
        "all clipped",
        "flash clipped",
        "room clipped",
        "not finite",
        "black subject",
        "flash that never came",
    ],
)
def test_scenes_without_an_answer_are_refused_in_one_sentence(
    frames, cloud, change_frames, change_radiances, word
):
    frames = change_frames(frames)
    radiances = noisy(frames) if change_radiances is None else change_radiances(noisy(frames))
    with pytest.raises(PlanError, match=word) as caught:
        solve(MemoryScene(frames, radiances, cloud), CONFIG)
    assert str(caught.value)[-1] in ".?"
    assert "\n" not in str(caught.value)
