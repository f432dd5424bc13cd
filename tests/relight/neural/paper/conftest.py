"""A small head in small pictures, solved once, that the paper's fit is tried on."""

import numpy as np
import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, expose, photograph

from relight.cloud import CloudConfig
from relight.face.plane import Plane
from relight.face.prior import FacePrior
from relight.face.surface import FaceSurface
from relight.neural.paper.config import PaperConfig
from relight.photometric import SolveConfig, solve

HEAD = Head()


@pytest.fixture(scope="session")
def scene():
    """Eighteen frames of 64 pixels, six of them lit."""
    frames = [expose(HEAD, photograph(HEAD, camera), 1.0) for camera in arc(count=18, size=64)]
    cloud = torch.from_numpy(cloud_of(HEAD, 3000, 0.0004)[0])
    return MemoryScene(frames, [frame.radiance for frame in frames], cloud)


@pytest.fixture(scope="session")
def solved(scene):
    return solve(scene, SolveConfig(cloud=CloudConfig(max_points=3000)))


@pytest.fixture(scope="session")
def config():
    return PaperConfig(crop=32, steps=6, validate_every=100, baked_views=4)


@pytest.fixture(scope="session")
def face(scene):
    """The front of the head as a face prior, from its formulas: texels on a grid, seen by who faces them."""
    y, x = np.meshgrid(np.linspace(0.06, -0.06, 256), np.linspace(-0.05, 0.05, 256), indexing="ij")
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)], axis=1)
    distance = HEAD.intersect(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape))
    points = origins - distance[:, None] * [0.0, 0.0, 1.0]
    normals = HEAD.normals(points)
    everywhere = torch.ones(256, 256, dtype=torch.bool)
    surface = FaceSurface(
        torch.from_numpy(points.reshape(256, 256, 3)).float(),
        torch.from_numpy(normals.reshape(256, 256, 3)).float(),
        everywhere,
        everywhere,
        None,
    )
    cosines, cameras = [], {}
    for view in scene.views:
        to_camera = view.camera.centre_world - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        cosine = (normals * to_camera).sum(axis=1).reshape(256, 256)
        if (cosine > 0.3).mean() > 0.5:
            cosines.append(torch.from_numpy(np.rint(255 * cosine.clip(0, 1))).to(torch.uint8))
            cameras[view.index] = view.camera
    plane = Plane((1.0, 0.0, 0.0), 0.0)
    return FacePrior("cloud", "by its formulas", surface, plane, cameras, torch.stack(cosines), None, {})
