"""Flash, parallax, colours and hull, each by itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from relight.masks.colour import colour_evidence
from relight.masks.flash import by_ratio, log_ratio
from relight.masks.frames import FrameSource
from relight.masks.hull import Votes, hull_evidence
from relight.masks.outcome import outline_shift_px
from relight.masks.silhouette import Silhouette, signed_distance_px, silhouette
from relight.masks.solve import attached, prior, solve, under
from relight.masks.sweep import carried, neighbours, register


def disc(size=96, radius=25.0, centre=(48.0, 48.0)):
    v, u = np.mgrid[0:size, 0:size] + 0.5
    return np.hypot(u - centre[0], v - centre[1]) < radius


def seen(inside):
    return Silhouette(inside, signed_distance_px(inside), np.ones(inside.shape, np.float32), 0.0)


def test_the_ratio_of_the_near_is_higher_and_more_light_is_never_less_evidence():
    inside = disc()
    rng = np.random.default_rng(0)
    # A head at 0.5 m and a wall at 2 m under a flash as strong as the room at 0.7 m.
    ratio = np.where(inside, np.log1p(0.49 / 0.25), np.log1p(0.49 / 4.0)) + rng.normal(0, 0.1, inside.shape)
    found = by_ratio(ratio.astype(np.float32), np.ones(inside.shape, np.float32), signed_distance_px(inside))
    assert found.separation > 5.0
    assert ((found.odds > 0) == inside).mean() > 0.99
    order = np.argsort(ratio, axis=None)
    assert (np.diff(found.odds.ravel()[order]) >= 0).all()


def test_a_flash_that_lights_all_alike_or_the_wall_more_is_no_evidence():
    inside = disc()
    distance = signed_distance_px(inside)
    trust = np.ones(inside.shape, np.float32)
    noise = np.random.default_rng(0).normal(0, 0.1, inside.shape).astype(np.float32)
    for ratio in (noise, noise - inside):
        found = by_ratio(ratio.astype(np.float32), trust, distance)
        assert not found.odds.any()
        assert found.separation < 1.0


def test_dark_pixels_have_little_to_say():
    lit = np.full((20, 20, 3), 0.3, np.float32)
    lit[:, :10] = 0.003  # one step of 8 bits
    ratio, trust = log_ratio(lit, lit / 3.0)
    assert trust[10, 15] > 0.9
    assert trust[10, 3] < 0.3
    assert ratio[10, 15] == pytest.approx(np.log(3.0), rel=0.05)
    assert abs(ratio[10, 3]) < 0.5


def test_no_light_at_all_is_finite():
    ratio, trust = log_ratio(np.zeros((8, 8, 3), np.float32), np.zeros((8, 8, 3), np.float32))
    assert np.isfinite(ratio).all()
    assert not trust.any()


def test_neighbours_come_from_both_sides_and_are_not_the_frame_itself(film):
    source = FrameSource(film.session, film.cameras, 96)
    frames = list(source.frames.values())
    chosen = neighbours(frames[4], frames, 0, 0.55)
    assert frames[4] not in chosen
    assert {frame.flash for frame in chosen} == {0}
    assert min(frame.index for frame in chosen) < 4 < max(frame.index for frame in chosen)
    assert neighbours(frames[4], frames, 0, 0.001) == []  # none so near


def test_head_matches_at_its_depth_and_the_wall_behind_it(film, scene):
    source = FrameSource(film.session, film.cameras, 96)
    frames = list(source.frames.values())
    frame = frames[3]
    view = silhouette(torch.from_numpy(scene.cloud()), frame.small, 0.003, 0.0005)
    found = register(frame, neighbours(frame, frames, 0, 0.55), source, view.depth, view.inside)
    far = view.distance_px < -3
    assert np.median(found.parallax[far]) < -0.5
    assert (found.parallax[far] > 0.5).mean() < 0.1
    assert np.median(found.parallax[view.distance_px > 3]) > -0.1  # smooth skin matches nearly anywhere
    assert found.matched.mean() > 0.95
    # In register, the neighbours' picture is the frame's own.
    error = np.abs(found.radiance - source.small(frame)).mean(axis=-1)
    assert np.median(error) < 0.01


def test_a_map_is_carried_to_where_its_pixels_go(scene):
    one, two = scene.camera_at(-4), scene.camera_at(4)
    depth = np.full((two.height, two.width), 0.55, np.float32)
    ramp = np.tile(np.arange(one.width, dtype=np.float32) + 0.5, (one.height, 1))
    found, count = carried([ramp], [one], two, depth)
    pixel = np.array([70.5, 64.5, 1.0])
    world = two.centre_world + (two.cam_from_world[:3, :3].T @ np.linalg.inv(two.K) @ pixel) * 0.55
    there = one.K @ (one.cam_from_world[:3, :3] @ world + one.cam_from_world[:3, 3])
    assert count[64, 70] == 1
    assert found[64, 70] == pytest.approx(there[0] / there[2], abs=0.01)


def test_colours_tell_sides_apart_and_unknown_windows_say_nothing():
    rng = np.random.default_rng(0)
    inside = disc()
    picture = np.where(inside[..., None], [0.7, 0.5, 0.4], [0.3, 0.4, 0.5]) + rng.normal(0, 0.03, (96, 96, 3))
    distance = signed_distance_px(inside)
    subject = (distance > 4).astype(np.float32)
    background = (distance < -4).astype(np.float32)
    odds = colour_evidence(picture.astype(np.float32), subject, background, 12)
    band = np.abs(distance) < 6
    assert ((odds > 0) == inside)[band].mean() > 0.98
    assert not odds[0, 0]  # no subject within reach
    nothing = colour_evidence(picture.astype(np.float32), 0 * subject, background, 12)
    assert not nothing.any()


def test_colours_that_are_alike_are_weak_evidence():
    picture = np.full((96, 96, 3), 0.5, np.float32)
    distance = signed_distance_px(disc())
    odds = colour_evidence(picture, (distance > 4).astype(np.float32), (distance < -4).astype(np.float32), 12)
    assert np.abs(odds).max() < 0.1


def test_a_point_off_the_masks_is_voted_out(scene):
    cameras = [scene.camera_at(a) for a in (-30, -10, 10, 30)]
    points = np.array([[0, 0, 0], [0.12, 0, 0], [0, 0, 9.0], [np.nan, 0, 0]])
    votes = Votes(points)
    for camera in cameras:
        votes.add(disc(camera.width, 15.0, (camera.width / 2, camera.width / 2)).astype(np.float32), camera)
    share = votes.share()
    assert share[0] == 0.0
    assert share[1] == 1.0
    assert share[2] == share[3] == 1.0  # in no picture: nothing speaks for them


def test_the_hull_takes_what_all_views_hold_and_no_more(scene):
    cameras = [scene.camera_at(a) for a in (-40, -20, 20, 40)]
    body = disc(cameras[0].width, 22.0, (cameras[0].width / 2, cameras[0].width / 2))
    masks = [body.astype(np.float32)] * 4
    middle = scene.camera_at(0)
    depth = np.full((middle.height, middle.width), 0.55, np.float32)
    claimed = np.zeros(depth.shape, bool)
    claimed[64, 64] = claimed[64, 100] = True
    odds = hull_evidence(middle, depth, claimed, masks, cameras)
    assert odds[0] > 0.5
    assert odds[1] < -2.0
    assert len(hull_evidence(middle, depth, claimed, [], [])) == 2
    assert not len(hull_evidence(middle, depth, np.zeros_like(claimed), masks, cameras))


def test_under_is_what_hangs_below_in_the_upright_picture():
    inside = np.zeros((10, 10), bool)
    inside[2:5, 3:7] = True
    inside[7, 3:5] = True
    below = under(inside, 0)
    assert below[8:, 3:7].all()
    assert below[5:, 5:7].all()
    assert not below[5:7, 3:5].any()  # the cloud goes on further down
    assert not below[:2].any()
    assert not below[:, :3].any()
    # The same scene on a sensor that lies on its side.
    assert np.array_equal(under(np.rot90(inside), 90), np.rot90(below))


def test_the_prior_is_sure_inside_and_leaves_room_above_but_not_below():
    odds = prior(seen(disc()), 0)
    assert odds[48, 48] > 4
    assert -3 < odds[20, 48] < -1  # three pixels above the outline
    assert odds[77, 48] < -5  # as far below it
    assert np.isfinite(prior(seen(np.zeros((20, 20), bool)), 0)).all()


def test_what_does_not_touch_the_cloud_is_dropped():
    mask = np.maximum(disc(), disc(96, 6.0, (10.0, 10.0))).astype(np.float32)
    result = attached(mask, seen(disc()))
    assert result[48, 48] == 1.0
    assert not result[:18, :18].any()


def test_an_empty_silhouette_gives_an_empty_mask():
    empty = np.zeros((32, 32), bool)
    mask = solve(np.full((32, 32, 3), 0.5, np.float32), prior(seen(empty), 0), seen(empty))
    assert not mask.any()


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (4, 0), (-2, 3)])
def test_a_shifted_outline_is_measured(dx, dy):
    mask = disc(128, 30.0, (64.0 + dx, 64.0 + dy)).astype(np.float32)
    shift = outline_shift_px(mask, seen(disc(128, 30.0, (64.0, 64.0))))
    # Outlines of whole pixels, and distances smoothed over two.
    assert shift == pytest.approx(np.array([dx, dy]), abs=0.8)


def test_frames_are_averaged_down_and_their_cameras_with_them(film):
    cameras = {0: replace(film.cameras[0])}
    source = FrameSource(film.session, cameras, 64)
    frame = source.frames[0]
    small, full = source.small(frame), source.radiance(frame)
    assert small.shape == (64, 64, 3)
    assert small.mean() == pytest.approx(full.mean(), rel=1e-4)
    assert frame.small.K[0, 0] == pytest.approx(0.5 * frame.camera.K[0, 0])
