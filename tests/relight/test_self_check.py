"""A right portrait gives its frames back; one of wrong geometry does not, and that is said or refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import Head, MemoryScene, arc, cloud_of, expose, photograph

from relight.alignment import Similarity
from relight.cloud import CloudConfig
from relight.errors import GeometryError
from relight.fit import REFUSED_DB, _judged
from relight.photometric import SolveConfig, solve
from relight.self_check import SelfCheck, check_portrait

HEAD = Head()


@pytest.fixture(scope="module")
def scene():
    frames = [expose(HEAD, photograph(HEAD, camera), 1.0) for camera in arc(size=96)]
    cloud = torch.from_numpy(cloud_of(HEAD, 5000, 0.0004)[0])
    return MemoryScene(frames, [frame.radiance for frame in frames], cloud)


@pytest.fixture(scope="module")
def portrait(scene):
    return solve(scene, SolveConfig(cloud=CloudConfig(max_points=4000)))


def test_a_solved_portrait_gives_its_frames_back(scene, portrait):
    check = check_portrait(portrait, scene)
    # 4,000 points in pictures of 96 pixels: what is lost is detail, not light.
    assert check.psnr_db > 28
    assert check.covered > 0.93


def test_a_portrait_somewhere_else_does_not(scene, portrait):
    aside = portrait.transformed(Similarity(1.0, np.eye(3), np.array([0.0, 0.12, 0.0])))
    assert check_portrait(aside, scene).covered < 0.6
    away = portrait.transformed(Similarity(1.0, np.eye(3), np.array([0.0, 5.0, 0.0])))
    assert check_portrait(away, scene) == SelfCheck(-np.inf, 0.0)


def test_a_portrait_of_the_wrong_albedo_is_seen_in_the_light(scene, portrait):
    pale = replace(portrait, albedo=2.0 * portrait.albedo, room_radiance=2.0 * portrait.room_radiance)
    assert check_portrait(pale, scene).psnr_db < REFUSED_DB


def test_found_geometry_that_does_not_hold_is_refused_and_given_one_is_doubted():
    wrong = SelfCheck(15.0, 0.5)
    with pytest.raises(GeometryError, match=r"15\.0 dB and covers 50%"):
        _judged(wrong, found=True)
    (sentence,) = _judged(wrong, found=False)
    assert sentence.startswith("Look twice")
    assert _judged(SelfCheck(23.0, 0.95), found=True)[0].startswith("Look twice")
    assert _judged(SelfCheck(35.0, 0.98), found=True) == []
