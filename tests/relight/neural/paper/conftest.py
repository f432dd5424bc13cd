"""A small head in small pictures, solved once, that the paper's fit is tried on."""

import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, expose, photograph

from relight.cloud import CloudConfig
from relight.neural.paper.config import PaperConfig
from relight.photometric import SolveConfig, solve


@pytest.fixture(scope="session")
def scene():
    """Eighteen frames of 64 pixels, six of them lit."""
    head = Head()
    frames = [expose(head, photograph(head, camera), 1.0) for camera in arc(count=18, size=64)]
    cloud = torch.from_numpy(cloud_of(head, 3000, 0.0004)[0])
    return MemoryScene(frames, [frame.radiance for frame in frames], cloud)


@pytest.fixture(scope="session")
def solved(scene):
    return solve(scene, SolveConfig(cloud=CloudConfig(max_points=3000)))


@pytest.fixture(scope="session")
def config():
    return PaperConfig(crop=32, steps=6, validate_every=100, baked_views=4)
