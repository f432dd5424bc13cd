"""A calibrated flash, its beam, strength and colour, and a noise model, in solves of an analytic subject."""

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
    write_session,
)

from calib.calibration import Calibration, Quantity, save_calibration
from capture.controls import Controls
from capture.ply import PointCloud
from capture.session import Session
from relight.cloud import CloudConfig
from relight.errors import PortraitError
from relight.lamp import Lamp, beam, lamp_of, lamp_of_portrait
from relight.lighting import CapturedLight
from relight.photometric import ALBEDO_95, SolveConfig, solve
from relight.plan import Action
from relight.planning import make_plan
from relight.render import render_view
from relight.scene import NoiseModel, load_scene

SIZE = 96
HEAD = Head()
CONFIG = SolveConfig(cloud=CloudConfig(max_points=4000), fit_gloss=False, fit_gains=False)
AXIS = np.array([0.1, -0.15, 1.0]) / np.linalg.norm([0.1, -0.15, 1.0])
SPOT = Lamp(AXIS, falloff=30.0)  # at 12 degrees, the edge of the head, half of what is on the axis


@pytest.fixture(scope="module")
def frames():
    return [photograph(HEAD, camera) for camera in arc(size=SIZE)]


@pytest.fixture(scope="module")
def cloud():
    return torch.from_numpy(cloud_of(HEAD, 5000, 0.0004)[0])


def under(lamp, frames, tint=(1.0, 1.0, 1.0)):
    """The frames under another lamp at the same place, by its definition."""
    changed = []
    for frame in frames:
        if not frame.camera.flash:
            changed.append(frame.radiance)
            continue
        pose = frame.camera.cam_from_world
        room = frame.albedo * HEAD.room(frame.normals)
        from_lamp = frame.points @ pose[:3, :3].T + pose[:3, 3] - FLASH_OFFSET_CAM_M
        cosine = (from_lamp @ lamp.axis_cam) / np.linalg.norm(from_lamp, axis=-1)
        share = np.clip(cosine, 0, 1) ** lamp.falloff
        changed.append(
            np.where(frame.hit[..., None], room + (frame.radiance - room) * share[..., None] * tint, 0)
        )
    return changed


def errors(portrait):
    """Medians: the normals' angle, degrees; relative errors of albedo times flash, and of albedo."""
    known = portrait.confidence.numpy() > 0.6
    points = portrait.points.double().numpy()[known]
    truth = HEAD.albedo(points)
    angles = np.degrees(
        np.arccos(np.clip((HEAD.normals(points) * portrait.normals_world.numpy()[known]).sum(1), -1, 1))
    )
    albedo = portrait.albedo.numpy()[known]
    product = albedo * portrait.c_flash / (C_FLASH * truth) - 1
    return np.median(angles), np.median(np.abs(product)), np.median(albedo / truth - 1, axis=0)


def test_a_narrow_beam_that_is_known_costs_nothing(frames, cloud):
    noisy = [with_noise(radiance, 0.01, k) for k, radiance in enumerate(under(SPOT, frames))]
    plain = [with_noise(frame.radiance, 0.01, k) for k, frame in enumerate(frames)]
    known = errors(solve(MemoryScene(frames, noisy, cloud, lamp=SPOT), CONFIG))
    unknown = errors(solve(MemoryScene(frames, noisy, cloud), CONFIG))
    usual = errors(solve(MemoryScene(frames, plain, cloud), CONFIG))
    # Known, it is as good as an even flash but for the noise, which doubles where it sends half the light.
    assert known[0] < 1.5 * usual[0]
    assert known[1] < 2 * usual[1]
    assert unknown[0] > 1.3 * known[0]
    assert unknown[1] > 5 * known[1]


def test_a_known_strength_makes_the_albedo_absolute_and_a_known_colour_true(frames, cloud):
    tint = np.array([1.2, 1.0, 0.7])
    radiances = under(Lamp(), frames, tint)
    lamp = Lamp(strength=C_FLASH * tint)
    portrait = solve(MemoryScene(frames, radiances, cloud, lamp=lamp), CONFIG)
    assert portrait.c_flash == pytest.approx(C_FLASH * tint, rel=0.02)  # the scale's own median over frames
    # The cloud's noise turns normals by 2 degrees and leaves 1 % in the albedo's scale.
    assert np.abs(errors(portrait)[2]).max() < 0.02
    assert portrait.info["absolute_albedo"] is True
    without = solve(MemoryScene(frames, radiances, cloud), CONFIG)
    assert without.info["absolute_albedo"] is False
    assert abs(errors(without)[2][0] - errors(without)[2][2]) > 0.4  # a blue that is 0.7 / 1.2 of red


def test_a_strength_that_cannot_be_is_not_believed(frames, cloud):
    lamp = Lamp(strength=np.full(3, C_FLASH / 5))
    portrait = solve(MemoryScene(frames, [frame.radiance for frame in frames], cloud, lamp=lamp), CONFIG)
    assert portrait.info["absolute_albedo"] is False
    assert "strength" in portrait.info["warnings"][0]
    known = portrait.confidence.numpy() > 0.6
    assert np.quantile(portrait.albedo.numpy()[known].mean(1), 0.95) == pytest.approx(ALBEDO_95, rel=0.05)


def test_a_noise_model_makes_noisy_frames_count_for_less(cloud):
    """From 1.2 m the flash adds a sixth of what it adds from 0.5 m, and the noise at black is the same."""
    cameras = [*arc(24, 2, SIZE), *arc(24, 2, SIZE, distance_m=1.2)]
    frames = [photograph(HEAD, camera) for camera in cameras]
    model = NoiseModel(np.full(3, 0.005), np.full(3, 1e-9))
    noisy = [with_noise(frame.radiance, 0.0, k, floor=0.005) for k, frame in enumerate(frames)]
    scene = MemoryScene(frames, noisy, cloud)
    with_model = errors(solve(replace(scene, noise=model), CONFIG))
    without = errors(solve(scene, CONFIG))
    # Far frames have six times the noise: least squares of equal numbers of both, with and without weights,
    # differ by sqrt((1 + 36) / 2 / 2) = 3; the robust weights of the solve take some of that away.
    assert with_model[1] < 0.6 * without[1]
    assert with_model[0] < without[0]


def test_small_noise_changes_next_to_nothing(frames, cloud):
    scene = MemoryScene(frames, [frame.radiance for frame in frames], cloud)
    quiet = replace(scene, noise=NoiseModel(np.full(3, 1e-6), np.full(3, 1e-9)))
    one, other = solve(scene, CONFIG), solve(quiet, CONFIG)
    # Weights of 1 - 1e-6 and the rest of float32.
    assert torch.allclose(one.albedo, other.albedo, rtol=1e-3, atol=1e-4)


def test_the_noise_of_the_mean_follows_the_model_by_sampling():
    from capture.radiometry import Radiometry
    from capture.response import Response

    model = NoiseModel(np.array([0.003, 0.002, 0.004]), np.array([2e-4, 1e-4, 3e-4]))
    colour = np.array([[1.6, -0.4, -0.2], [-0.3, 1.5, -0.2], [0.0, -0.6, 1.6]])
    radiometry = Radiometry(Response("linear"), flat_field=np.array([-0.3]), colour=colour)
    exposure = np.tile(np.array([0.4, 0.3, 0.2], np.float32), (8, 8, 1))
    rng = np.random.default_rng(6)
    sigma = np.sqrt(model.read**2 + model.shot * exposure)
    draws = np.stack(
        [
            radiometry.radiance((exposure + rng.normal(size=exposure.shape) * sigma).astype(np.float32))
            for _ in range(4000)
        ]
    )
    sampled = draws.mean(axis=-1).var(axis=0)
    # A variance from 4,000 draws is known to 2.2 %; the largest of 64 lies within four of these.
    assert np.abs(sampled / model.variance(exposure, radiometry) - 1).max() < 0.09


def test_a_beam_is_one_on_its_axis_and_finite_behind():
    axis = torch.tensor([0.0, 0.0, 1.0])
    to_light = torch.tensor([[0.0, 0.0, -1.0], [0.0, -0.6, -0.8], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    share = beam(to_light, axis, 2.0)
    assert share[:2].tolist() == pytest.approx([1.0, 0.64])
    assert ((share > 0) & (share <= 1)).all()
    assert (beam(to_light, axis, 0.0) == 1).all()


def test_what_a_calibration_does_not_know_is_as_without_one():
    lamp = lamp_of(Calibration())
    assert (lamp.axis_cam.tolist(), lamp.falloff, lamp.strength) == ([0, 0, 1], 0.0, None)
    colour = np.diag([2.0, 1.0, 0.5])
    known = Calibration(
        colour=Quantity.of(colour, "1", "chart"), flash_strength=Quantity.of([0.1, 0.1, 0.1], "m^2", "board")
    )
    assert lamp_of(known).strength.tolist() == pytest.approx([0.2, 0.1, 0.05])


def test_a_session_brings_its_lamp_unless_it_was_calibrated_otherwise(frames, tmp_path):
    cloud = PointCloud(*cloud_of(HEAD, 400, 0.0004), None)
    session = write_session(tmp_path / "S", frames[:6], cloud)

    def lamp(**made_with):
        strength = Quantity.of([0.1, 0.1, 0.1], "m^2", "board", made_with=Controls(**made_with))
        noise = Quantity.of([0.001] * 3, "1", "pairs")
        falloff = Quantity.of(3.0, "1", "board")
        save_calibration(
            Calibration(flash_strength=strength, flash_falloff=falloff, noise_read=noise, noise_shot=noise),
            session.calibration_path,
        )
        return load_scene(Session.open(session.path), frames=range(6))

    scene = lamp(exposure_s=0.01)  # the session does not tell its exposure: no contradiction
    assert scene.lamp.strength.tolist() == [0.1, 0.1, 0.1]
    assert scene.lamp.falloff == 3.0
    assert scene.calibration_warnings == []
    assert scene.observe(scene.views[0]).variance.shape == (SIZE, SIZE)
    Session.open(session.path).update_info(device={"exposure_s": 0.02})
    scene = lamp(exposure_s=0.01)
    assert scene.lamp.strength is None
    assert scene.lamp.falloff == 3.0  # where it shines depends on no setting
    assert "flash_strength" in scene.calibration_warnings[0]


def test_the_plan_says_what_of_a_calibration_is_applied(frames, tmp_path):
    session = write_session(tmp_path / "S", frames[:6], PointCloud(*cloud_of(HEAD, 400, 0.0004), None))

    def planned():
        plan = make_plan(Session.open(session.path))
        return next(decision for decision in plan.decisions if decision.name == "calibration")

    assert planned().action is Action.GIVEN
    assert planned().reason == "the flash's place"
    dark = Quantity.of([0.01] * 3, "1", "darks", made_with=Controls(gain=4.0))
    save_calibration(Calibration(dark=dark), session.calibration_path)
    Session.open(session.path).update_info(device={"iso": 200})
    assert "dark (the gain is 2, not 4)" in planned().reason
    session.calibration_path.unlink()
    assert planned().action is Action.SKIP


def test_a_lit_frame_is_given_back_through_the_beam(frames, cloud):
    radiances = under(SPOT, frames)
    portrait = solve(MemoryScene(frames, radiances, cloud, lamp=SPOT), CONFIG)
    frame, radiance = next((f, r) for f, r in zip(frames, radiances, strict=True) if f.camera.flash)
    maps, rendered = render_view(portrait, frame.camera, {"captured": CapturedLight()}, shadows=False)
    inside = (frame.hit & (maps.mask.numpy() > 0.99)).nonzero()
    off = rendered["captured"].numpy()[inside].mean(1) / radiance[inside].mean(1) - 1
    assert abs(np.median(off)) < 0.01
    even = replace(portrait, info={})
    _, wrong = render_view(even, frame.camera, {"captured": CapturedLight()}, shadows=False)
    unlike = wrong["captured"].numpy()[inside].mean(1) / radiance[inside].mean(1) - 1
    assert np.median(np.abs(unlike)) > 5 * np.median(np.abs(off))


@pytest.mark.parametrize(
    "said", [3, {"axis_cam": [0, 0], "falloff": 1}, {"axis_cam": [0, 0, 1], "falloff": -1}]
)
def test_a_beam_that_is_none_is_refused(said):
    with pytest.raises(PortraitError, match="flash_beam"):
        lamp_of_portrait({"flash_beam": said})
    assert lamp_of_portrait({}).falloff == 0.0
