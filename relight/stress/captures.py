"""Captures of the subject as a fit sees them, right ones and such as have gone wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.radiometry import Radiometry
from capture.response import Response
from relight.lamp import Lamp
from relight.scene import CLIPPED_RADIANCE, NoiseModel, Observation, Scene, View
from relight.stress.subject import (
    FLASH_OFFSET_CAM_M,
    SUBJECT,
    Floats,
    Subject,
    arc,
    looking_at_origin,
    normals_at,
    photograph,
    surface_points,
)


class FilmedScene(Scene):
    """What `relight.scene.Scene` offers to a fit, from arrays instead of a session.

    Attributes:
        radiances: [H, W, 3] of each view; to be spoilt.
        masks: [H, W] of each view; to be spoilt.
        noise: Of the pixels, where it is known.
    """

    noise: NoiseModel | None = None

    def __init__(
        self,
        cameras: Sequence[Camera],
        radiances: Sequence[NDArray[np.float32]],
        masks: Sequence[NDArray[np.bool_]],
        points: Floats,
        normals: Floats | None = None,
        clip: float = CLIPPED_RADIANCE,
    ) -> None:
        """A scene.

        Args:
            cameras: With flags.
            radiances: [H, W, 3] of each.
            masks: [H, W] of each.
            points: [P, 3] cloud.
            normals: [P, 3] given with it, or None.
            clip: Radiance at which pixels are clipped.
        """
        self.points = torch.from_numpy(points.astype(np.float32))
        self.normals_world = None if normals is None else torch.from_numpy(normals.astype(np.float32))
        self.views = tuple(View(k, camera, int(camera.flash or 0)) for k, camera in enumerate(cameras))
        self.flash_offset_cam_m = FLASH_OFFSET_CAM_M
        self.device = torch.device("cpu")
        self.radiances, self.masks = radiances, masks
        self._clip = clip

    @property
    def rotation_deg(self) -> int:
        """Frames are upright."""
        return 0

    def observe(self, view: View) -> Observation:
        """Pixels as they are; what is clipped or no number is not valid (NaN fails the comparison)."""
        radiance = torch.from_numpy(self.radiances[view.index])
        valid = (radiance.abs().amax(dim=-1) < self._clip).float()
        mask = torch.from_numpy(self.masks[view.index].astype(np.float32))
        variance = None
        if self.noise is not None:
            exposure = self.radiances[view.index]
            variance = torch.from_numpy(self.noise.variance(exposure, Radiometry(Response("linear"))))
        return Observation(radiance, valid, mask, variance)


def film(
    subject: Subject = SUBJECT,
    cameras: Sequence[Camera] | None = None,
    cloud: int = 3000,
    clip: float = CLIPPED_RADIANCE,
) -> FilmedScene:
    """A scene of the subject: ten cameras unless others are given, masks, and a cloud of so many points."""
    cameras = arc(10) if cameras is None else cameras
    frames = [photograph(subject, camera) for camera in cameras]
    radiances, masks = [frame[0] for frame in frames], [frame[1] for frame in frames]
    scene = FilmedScene(cameras, radiances, masks, surface_points(cloud), clip=clip)
    scene.lamp = Lamp(falloff=subject.beam)
    return scene


def filmed_twice() -> FilmedScene:
    """Every frame two times."""
    return film(cameras=[camera for camera in arc(10) for _ in range(2)])


def with_broken_pixels(
    values: Sequence[float], count: int = 30, clip: float = CLIPPED_RADIANCE
) -> FilmedScene:
    """Some values in so many pixels each of every frame, in one channel."""
    scene = film(clip=clip)
    random = np.random.default_rng(0)
    for view in scene.views:
        for value in values:
            v, u = random.integers(0, view.camera.height, (2, count))
            scene.radiances[view.index][v, u, random.integers(0, 3)] = value
    return scene


def with_known_noise(read: float, shot: float, values: Sequence[float] = ()) -> FilmedScene:
    """A noise model, and some values in some pixels of every frame."""
    scene = with_broken_pixels(values)
    scene.noise = NoiseModel(np.full(3, read), np.full(3, shot))
    return scene


def with_broken_frame() -> FilmedScene:
    """One frame without any number."""
    scene = film()
    scene.radiances[3][:] = np.nan
    return scene


def with_hostile_cloud() -> FilmedScene:
    """Points at the cameras, behind them, without a number, and copies."""
    scene = film()
    centres = np.stack([view.camera.centre_world for view in scene.views])
    hostile = [centres, 2.0 * centres, centres + 1e-9, np.full((5, 3), np.nan), np.full((5, 3), np.inf)]
    copies = scene.points[:100].double().numpy()
    scene.points = torch.cat([scene.points, torch.from_numpy(np.concatenate([*hostile, copies])).float()])
    return scene


def with_hostile_normals() -> FilmedScene:
    """Normals given with the cloud, of which some are zero and some no numbers."""
    scene = film()
    normals = normals_at(scene.points.double().numpy())
    normals[::3], normals[1::7] = 0.0, np.nan
    scene.normals_world = torch.from_numpy(normals).float()
    return scene


def from_the_skin() -> FilmedScene:
    """Two of the cameras a millimetre from the surface."""
    close = [looking_at_origin([0.0, 0.0, 0.101], 48, flash=flash) for flash in (0, 1)]
    return film(cameras=[*arc(10), *close])


def looking_away() -> FilmedScene:
    """Two of the cameras turned away from the subject."""
    away = []
    for flash in (0, 1):
        camera = looking_at_origin([0.0, 0.1, 0.5], 48, flash=flash)
        pose = camera.cam_from_world.copy()
        pose[[0, 2]] *= -1.0  # half a turn about the camera's own vertical
        away.append(replace(camera, cam_from_world=pose))
    return film(cameras=[*arc(10), *away])


def of_constant_images(radiance: float) -> FilmedScene:
    """Every pixel of every frame the same; NaN is allowed."""
    scene = film()
    for frame in scene.radiances:
        frame[:] = radiance
    return scene


def with_empty_masks() -> FilmedScene:
    """No pixel of any frame is of the subject."""
    scene = film()
    for mask in scene.masks:
        mask[:] = False
    return scene


def behind_the_cameras() -> FilmedScene:
    """The cloud where no camera looks."""
    scene = film()
    scene.points = scene.points + torch.from_numpy(scene.views[4].camera.centre_world * 4.0).float()
    return scene


def with_cloud_of_nan() -> FilmedScene:
    """No point has a place."""
    scene = film()
    scene.points = torch.full_like(scene.points, torch.nan)
    return scene
