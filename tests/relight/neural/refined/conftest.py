"""A small head in small pictures, solved once, that the refinement is tried on."""

from dataclasses import replace

import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, photograph

from relight.cloud import CloudConfig
from relight.neural.refined.config import RefinedConfig
from relight.photometric import SolveConfig, solve

HEAD = Head()


@pytest.fixture(scope="session")
def scene():
    """Eighteen frames of 52 pixels, which is no multiple of eight; six of them lit."""
    frames = [photograph(HEAD, camera) for camera in arc(count=18, size=52)]
    cloud = torch.from_numpy(cloud_of(HEAD, 2000, 0.0004)[0])
    return MemoryScene(frames, [frame.radiance for frame in frames], cloud)


@pytest.fixture(scope="session")
def solved(scene):
    return solve(scene, SolveConfig(cloud=CloudConfig(max_points=2000)))


@pytest.fixture(scope="session")
def dim(solved):
    """The solve with lights that are too dark by a fifth: there is something to be learned."""
    return replace(
        solved,
        room_radiance=0.8 * solved.room_radiance,
        c_flash=tuple(0.8 * value for value in solved.c_flash),
    )


@pytest.fixture(scope="session")
def config():
    return RefinedConfig(
        steps=40, patch=32, rate=5e-3, descriptors=2, widths=(8, 12, 16), check_every=20, patience=9
    )
