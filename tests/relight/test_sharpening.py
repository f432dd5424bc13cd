"""Points of a striped board that begin blurred, and what frames made by formula give them back."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from analytic_scene import C_FLASH, FLASH_OFFSET_CAM_M, Frame, MemoryScene, looking_at, portrait_of

from relight.lighting import CapturedLight, shade
from relight.maps import splat_maps
from relight.sharpening import sharpen

HALF_M, SPACING_M = 0.05, 0.0027  # a point every 0.8 pixels
SIZE, FOCAL_PX, DISTANCE_M = 48, 150.0, 0.5
WAVE_M = 0.015  # 4.5 pixels
MEAN, STRIPES = np.array([0.5, 0.4, 0.3]), np.array([0.12, 0.1, 0.08])
ROOM = 0.4
BLURRED = 0.6  # of the stripes' contrast is left in the points
RIM_PX = 4  # from the board's edge, where fewer points and pixels say something


def stripes(points, contrast=1.0):
    """Albedo [..., 3] of the board at points [..., 3]."""
    wave = np.sin(2 * np.pi / WAVE_M * (0.8 * points[..., :1] + 0.6 * points[..., 1:2]))
    return MEAN + contrast * STRIPES * wave


def plain(points):
    return MEAN + 0.0 * points


def photograph(camera, albedo=stripes, gain=1.0):
    """The board at z = 0 in a frame; what faces the flash with a cosine c at d has C_FLASH c / d^2 of it."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = (
        np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    )
    eye = camera.centre_world
    points = eye - rays * (eye[2] / rays[..., 2:])
    hit = (np.abs(points[..., :2]) < HALF_M).all(axis=-1)
    colour, light = albedo(points), np.full(hit.shape, ROOM)
    if camera.flash:
        to_flash = eye + FLASH_OFFSET_CAM_M @ camera.cam_from_world[:3, :3] - points
        square = (to_flash**2).sum(axis=-1)
        light = light + gain * C_FLASH * to_flash[..., 2] / square**1.5
    on = hit[..., None]
    normals = np.broadcast_to([0.0, 0, 1], points.shape)
    return Frame(camera, hit, points * on, normals * on, colour * on, colour * light[..., None] * on)


def cameras(count=16, every=2):
    """About the board, every second with the flash."""
    return [
        looking_at(
            np.array([0.12 * np.sin(2.1 * k), 0.1 * np.cos(3.7 * k), DISTANCE_M]),
            np.array([0.003 * np.sin(5 * k), 0.003 * np.cos(4 * k), 0]),
            size=SIZE,
            focal_px=FOCAL_PX,
            flash=int(k % every == 1),
        )
        for k in range(count)
    ]


@cache
def points():
    steps = np.arange(-HALF_M + SPACING_M / 2, HALF_M, SPACING_M)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    return np.stack([x, y, np.zeros_like(x)], axis=1)


def inner(margin_m=RIM_PX * DISTANCE_M / FOCAL_PX):
    return (np.abs(points()[:, :2]) < HALF_M - margin_m).all(axis=1)


def board(room, albedo, **given):
    """A portrait of the board's points with these [P, 3]."""
    return portrait_of(
        points(),
        np.tile([0.0, 0, 1], (len(points()), 1)),
        SPACING_M,
        room_radiance=room,
        albedo=albedo,
        c_flash=(C_FLASH,) * 3,
        flash_offset_cam_m=tuple(FLASH_OFFSET_CAM_M),
        **given,
    )


def blurred(**given):
    dull = stripes(points(), BLURRED)
    return board(ROOM * dull, dull, **given)


def scene_of(frames, radiances=None, **given):
    nothing = torch.zeros(0, 3)
    return MemoryScene(
        frames, [f.radiance for f in frames] if radiances is None else radiances, nothing, **given
    )


def drawn(portrait, camera):
    return shade(
        CapturedLight(),
        splat_maps(portrait, camera),
        camera=camera,
        c_flash=portrait.c_flash,
        flash_offset_cam_m=portrait.flash_offset_cam_m,
    ).numpy()


def missing(portrait, frames):
    """RMS of what drawn frames lack of the real ones, the board's rim left out."""
    errors = []
    for frame in frames:
        near = (np.abs(frame.points[..., :2]) < HALF_M - RIM_PX * DISTANCE_M / FOCAL_PX).all(
            axis=-1
        ) & frame.hit
        errors.append((drawn(portrait, frame.camera) - frame.radiance)[near])
    return float(np.sqrt((np.concatenate(errors) ** 2).mean()))


def rms(values):
    return float(np.sqrt((np.asarray(values, np.float64)[inner()] ** 2).mean()))


def drawn_at(camera, pixels):
    """Points [P] bool that lie in these rows and columns of a picture."""
    uv_px = (points() @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]) @ camera.K.T
    uv_px = uv_px[:, :2] / uv_px[:, 2:]
    return ((uv_px >= pixels.start) & (uv_px < pixels.stop)).all(axis=1)


def told(scene, portrait, passes=1):
    said = []
    sharpen(scene, portrait, passes, lambda stage, fraction: said.append((stage, fraction)))
    return said


def half_spoilt(how):
    """A scene in whose frames what shows the board at x < 0 is no measurement."""
    frames = [photograph(camera) for camera in cameras(8)]
    left = [frame.points[..., 0] < 0 for frame in frames]
    radiances = [frame.radiance.copy() for frame in frames]
    if how == "off the mask":
        frames = [replace(f, hit=f.hit & ~side) for f, side in zip(frames, left, strict=True)]
    else:
        for radiance, side in zip(radiances, left, strict=True):
            radiance[side] = {"clipped": 1.0, "not a number": np.nan}[how]
    return scene_of(frames, radiances)


def test_detail_comes_back_and_more_of_it_with_every_pass():
    frames = [photograph(camera) for camera in cameras()]
    unlit, lit = frames[::2], frames[1::2]
    scene, true = scene_of(frames), stripes(points())
    dull = blurred()
    once = sharpen(scene, dull, 1)
    twice = sharpen(scene, dull, 2)
    # What drawn frames lack falls to an eighth (unlit) and to 0.27 (lit) by one pass, to a twentieth and to
    # 0.11 by two: where the room's part is right is known sooner than the albedo's.
    assert missing(once, unlit) < 0.2 * missing(dull, unlit)
    assert missing(once, lit) < 0.35 * missing(dull, lit)
    assert missing(twice, unlit) < 0.5 * missing(once, unlit)
    assert missing(twice, lit) < 0.5 * missing(once, lit)
    # Errors of the points' values fall to 0.17 and 0.27. They rise again when drawn frames come nearer still:
    # points then make up for their splats' width.
    assert rms(once.albedo.numpy() - true) < 0.25 * rms(dull.albedo.numpy() - true)
    assert rms(once.room_radiance.numpy() - ROOM * true) < 0.35 * rms(
        dull.room_radiance.numpy() - ROOM * true
    )


@pytest.mark.parametrize("flash", [0, 1])
def test_one_frame_is_enough(flash):
    frames = [photograph(camera) for camera in cameras(2)[flash : flash + 1]]
    true = stripes(points())
    dull = blurred() if flash == 0 else board(ROOM * true, stripes(points(), BLURRED))
    sharp = sharpen(scene_of(frames), dull, 1)
    # 0.48 and 0.63 are left: one frame stands against the prior for no change, and in the lit one the room's
    # stripes, which are right in the points, are drawn dull.
    assert missing(sharp, frames) < 0.75 * missing(dull, frames)


def test_without_lit_frames_the_albedo_is_left_and_without_unlit_ones_the_room():
    frames = [photograph(camera) for camera in cameras(8)]
    dull = blurred()
    sharp = sharpen(scene_of(frames[::2]), dull, 1)
    assert torch.equal(sharp.albedo, dull.albedo)
    assert missing(sharp, frames[::2]) < 0.25 * missing(dull, frames[::2])  # 0.16
    dull = board(ROOM * stripes(points()), stripes(points(), BLURRED))
    sharp = sharpen(scene_of(frames[1::2]), dull, 1)
    assert torch.equal(sharp.room_radiance, dull.room_radiance)
    assert missing(sharp, frames[1::2]) < 0.65 * missing(dull, frames[1::2])  # 0.51, the room's part is left


def test_what_draws_its_frames_already_is_left_alone():
    frames = [photograph(camera, plain) for camera in cameras(8)]
    exact = board(ROOM * plain(points()), plain(points()))
    sharp = sharpen(scene_of(frames), exact, 2)
    # Drawn depths are uneven by some hundredths of a millimetre of half a metre, and the flash with them.
    np.testing.assert_allclose(sharp.albedo, exact.albedo, atol=1e-4)
    np.testing.assert_allclose(sharp.room_radiance, exact.room_radiance, atol=1e-6)


def test_an_albedo_that_is_wrong_all_over_stays_as_it_is():
    frames = [photograph(camera, plain) for camera in cameras(8)]
    dark = board(ROOM * plain(points()), 0.9 * plain(points()))
    sharp = sharpen(scene_of(frames), dark, 1)
    change = (sharp.albedo - dark.albedo).abs().numpy()
    # All of the error would be 0.05; what neighbours tell of it differs by the angles between them.
    assert change[inner()].max() < 1e-4


@pytest.mark.parametrize("flash", [0, 1])
@pytest.mark.parametrize("adds", [(0.3, 0.3, 0.3), (0.2, -0.1, -0.1)], ids=["bright", "red"])
def test_what_passes_in_one_frame_does_not_enter(adds, flash):
    frames = [photograph(camera, plain) for camera in cameras(8)]
    radiances = [frame.radiance.copy() for frame in frames]
    radiances[2 + flash][20:28, 20:28] += adds
    exact = board(ROOM * plain(points()), plain(points()))
    sharp = sharpen(scene_of(frames, radiances), exact, 1)
    # A mean of the two frames of a half would take in 0.09 or 0.13 of it, one of four lit frames at least 0.1
    # of albedo. With Cauchy's weights nothing counts for more than half of a usual difference (0.026 and
    # 0.05; half as much again in one channel), and that only at the edge, where pixels mix it with the board.
    assert (sharp.room_radiance - exact.room_radiance).abs().max() < 0.012
    assert (sharp.albedo - exact.albedo).abs().max() < 0.012
    inside = drawn_at(frames[2 + flash].camera, slice(21, 27))
    assert inside.sum() > 30
    assert (sharp.room_radiance - exact.room_radiance)[inside].abs().max() < 0.006
    assert (sharp.albedo - exact.albedo)[inside].abs().max() < 0.006


@pytest.mark.parametrize("how", ["off the mask", "clipped", "not a number"])
def test_pixels_that_say_nothing_change_nothing(how):
    dull = blurred()
    sharp = sharpen(half_spoilt(how), dull, 2)
    untold, well_told = points()[:, 0] < 0, (points()[:, 0] > 0.01) & inner()
    for name in ("albedo", "room_radiance"):
        before, after = getattr(dull, name), getattr(sharp, name)
        assert torch.equal(after[untold], before[untold]), name
        assert after.isfinite().all()
        assert (after - before)[well_told].abs().mean() > 0.01


def test_points_that_no_frame_sees_stay_as_they_are():
    frames = [photograph(camera) for camera in cameras(8)]
    away = torch.from_numpy(points()[:, 0] < 0)
    dull = blurred()
    dull = replace(dull, normals_world=torch.where(away[:, None], -1.0, 1.0) * dull.normals_world)
    sharp = sharpen(scene_of(frames), dull, 1)
    assert torch.equal(sharp.albedo[away], dull.albedo[away])
    assert torch.equal(sharp.room_radiance[away], dull.room_radiance[away])
    assert not torch.equal(sharp.albedo[~away], dull.albedo[~away])


def test_a_lone_point_keeps_its_albedo():
    frames = [photograph(camera) for camera in cameras(4)]
    normal = np.array([[0.0, 0, 1]])
    lone = portrait_of(np.zeros((1, 3)), normal, 0.05, albedo=0.5, room_radiance=0.2, c_flash=(C_FLASH,) * 3)
    sharp = sharpen(scene_of(frames), lone, 1)
    assert torch.equal(sharp.albedo, lone.albedo)
    assert sharp.room_radiance.isfinite().all()


def test_a_flash_that_was_stronger_is_told_from_stripes():
    gains = [1.5, 2.0] * 4
    frames = [photograph(camera, gain=gains[k // 2]) for k, camera in enumerate(cameras())]
    true = stripes(points())
    before = rms(blurred().albedo.numpy() - true)
    known, unknown = (
        rms(sharpen(scene_of(frames), blurred(info=info), 1).albedo.numpy() - true)
        for info in ({"flash_gains": gains}, {})
    )
    # As without gains, to 0.2; a flash taken for usual differs by more than blur does, and little comes back.
    assert known < 0.25 * before
    assert unknown > 2 * known


@pytest.mark.parametrize("c_flash", [C_FLASH, 0.0])
def test_values_stay_finite_and_do_not_fall_below_black(c_flash):
    def down_to_black(x):
        return 0.1 * (stripes(x) - plain(x) + STRIPES)

    frames = [photograph(camera, down_to_black) for camera in cameras(8)]
    grey = board(np.full((len(points()), 3), 0.004), np.full((len(points()), 3), 0.01))
    sharp = sharpen(scene_of(frames), replace(grey, c_flash=(c_flash,) * 3), 3)
    for values in (sharp.albedo, sharp.room_radiance):
        assert values.isfinite().all()
        assert values.min() >= 0


def test_a_black_board_stays_black():
    frames = [photograph(camera, lambda x: 0.0 * x) for camera in cameras(4)]
    black = board(np.zeros_like(points()), np.zeros_like(points()))
    sharp = sharpen(scene_of(frames), black, 1)
    assert (sharp.albedo == 0).all()
    assert (sharp.room_radiance == 0).all()


@pytest.mark.parametrize("kinds", [(0, 1), (0,), (1,)])
def test_progress_goes_from_nothing_to_all(kinds):
    frames = [photograph(camera) for camera in cameras(6) if camera.flash in kinds]
    said = told(scene_of(frames), blurred(), 2)
    fractions = [fraction for _, fraction in said]
    assert {stage for stage, _ in said} == {"sharpen"}
    assert fractions[0] == 0
    assert fractions[-1] == 1
    assert fractions == sorted(fractions)
