"""Metres come from a flash well beside the lens or from a head, each with its error; else a stated guess."""

import math
from dataclasses import replace
from functools import cache

import analytic_scene
import numpy as np
import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, photograph, with_noise
from face_shapes import sitter

from relight.scale import CAMERA_DISTANCE_M, FALLBACK_SIGMA, find_scale
from relight.scale_from_flash import flash_samples, scale_from_flash


def resized(camera, factor):
    """The camera in a world of another unit."""
    cam_from_world = camera.cam_from_world.copy()
    cam_from_world[:3, 3] *= factor
    return replace(camera, cam_from_world=cam_from_world)


@cache
def photographs(offset_m):
    """Frames of an analytic head under a flash at an offset, every third with the flash."""
    before = analytic_scene.FLASH_OFFSET_CAM_M
    analytic_scene.FLASH_OFFSET_CAM_M = np.array(offset_m)
    try:
        return [photograph(Head(), camera) for camera in arc(24, 3, 48)]
    finally:
        analytic_scene.FLASH_OFFSET_CAM_M = before


def flash_of(offset_m, factor):
    """What the flash adds there, in a world of 1 / factor metres."""
    frames = photographs(offset_m)
    points, normals = cloud_of(Head(), 4000)
    scene = MemoryScene(
        [replace(frame, camera=resized(frame.camera, factor)) for frame in frames],
        [with_noise(frame.radiance, 0.02, seed) for seed, frame in enumerate(frames)],
        torch.from_numpy(points * np.float32(factor)),
        flash_offset_cam_m=np.zeros(3),
    )
    return flash_samples(scene, points * factor, normals, 0.004 * factor)


@pytest.mark.parametrize("factor", [1.0, 7.0])
def test_a_flash_ten_centimetres_off_tells_the_scale(factor):
    offset = (0.1, 0.03, 0.0)
    found = scale_from_flash(flash_of(offset, factor), np.array(offset), 0.75 / factor)
    assert found.sigma_relative < 0.08
    # Three of the stated standard errors.
    assert abs(found.metres_per_unit * factor - 1.0) < 3 * found.sigma_relative
    assert found.offset_share == pytest.approx(0.104 / 0.5, rel=0.1)


def test_a_flash_at_the_lens_tells_nothing_that_a_head_does_not():
    offset = (0.01, -0.005, 0.0)
    found = scale_from_flash(flash_of(offset, 1.0), np.array(offset), 1.0)
    assert found.sigma_relative > 0.2
    assert scale_from_flash(flash_of(offset, 1.0), np.zeros(3), 1.0) is None


def test_too_few_flash_frames_tell_nothing():
    samples = flash_of((0.1, 0.03, 0.0), 1.0)
    few = replace(samples, weight=samples.weight * (np.arange(len(samples.weight)) < 3)[:, None])
    assert scale_from_flash(few, np.array([0.1, 0.0, 0.0]), 1.0) is None


def sitter_before_cameras(seed, factor):
    points, normals, albedo = sitter(seed)
    front = (normals[:, 2] > -0.4) & (points[:, 1] > -0.25)
    cameras = {k: resized(camera, factor) for k, camera in enumerate(arc(9, 3))}
    return factor * points[front], normals[front], albedo[front], cameras


@pytest.mark.parametrize(("seed", "factor"), [(3, 1.0), (0, 12.0)])  # bald; short hair on the sides
def test_a_head_tells_the_scale_to_what_heads_differ(seed, factor):
    points, normals, albedo, cameras = sitter_before_cameras(seed, factor)
    scale = find_scale(points, normals, albedo, cameras)
    assert scale.source == "head"
    assert 0.05 < scale.sigma_relative < 0.12
    assert abs(math.log(scale.metres_per_unit * factor)) < 2 * scale.sigma_relative
    # Hair is no head: with it only the face is measured.
    assert ("head breadth" in scale.reason) == (seed == 3)


def test_the_flash_is_preferred_where_it_knows_better():
    points, normals, albedo, cameras = sitter_before_cameras(3, 1.0)
    offset = (0.1, 0.03, 0.0)
    samples = flash_of(offset, 1.0)
    scale = find_scale(points, normals, albedo, cameras, flash=samples, flash_offset_cam_m=np.array(offset))
    assert scale.source == "flash"
    assert abs(scale.metres_per_unit - 1.0) < 3 * scale.sigma_relative
    weak = find_scale(
        points, normals, albedo, cameras, flash=samples, flash_offset_cam_m=np.array([0.004, 0, 0])
    )
    assert weak.source == "head"
    assert "flash" in weak.reason


def test_without_a_head_the_usual_distance_is_assumed_and_said():
    i = np.arange(20_000) + 0.5
    z, phi = 1 - 2 * i / 20_000, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    normals = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1)
    cameras = {k: resized(camera, 3.0) for k, camera in enumerate(arc(9, 3))}
    scale = find_scale(0.3 * normals, normals, None, cameras)
    assert scale.source == "distance"
    assert scale.sigma_relative == FALLBACK_SIGMA
    # Cameras are 0.5 m from the middle and go up and down by 0.12 m, times three.
    assert scale.metres_per_unit == pytest.approx(CAMERA_DISTANCE_M / (3 * 0.507), rel=0.02)
    assert "many planes" in scale.reason
    assert scale.as_json()["source"] == "distance"


def test_neither_points_nor_cameras_is_a_mistake():
    with pytest.raises(ValueError, match="cameras and points"):
        find_scale(np.zeros((0, 3)), np.zeros((0, 3)), None, dict(enumerate(arc(3))))
    with pytest.raises(ValueError, match="cameras and points"):
        find_scale(np.zeros((5, 3)), np.zeros((5, 3)), None, {})
    nowhere = np.full((5, 3), np.nan)
    with pytest.raises(ValueError, match="cameras and points"):
        find_scale(nowhere, nowhere, None, dict(enumerate(arc(3))))
