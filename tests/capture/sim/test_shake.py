from dataclasses import replace

import numpy as np
import pytest

from capture.cameras import Camera
from capture.sim import Rig
from capture.sim.shake import ShakeConfig

CAMERA = Camera("x", 80, 60, np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]]), np.eye(4))


def test_about_the_asked_share_of_frames_is_blurred_and_always_the_same_ones() -> None:
    shake = ShakeConfig(share=0.2, seed=4)
    chosen = [shake.blurs(k) for k in range(1000)]
    assert 150 < sum(chosen) < 250  # 200, of standard deviation 13
    assert chosen == [ShakeConfig(share=0.2, seed=4).blurs(k) for k in range(1000)]
    assert not any(ShakeConfig().blurs(k) for k in range(100))


def test_a_point_becomes_a_streak_of_the_asked_length_about_where_it_was() -> None:
    radiance = np.zeros((60, 80, 3), np.float32)
    radiance[30, 40] = 1.0
    for index in range(5):
        streak = ShakeConfig(share=1.0, length_px=10.0).blur(radiance, CAMERA, index)[..., 0]
        assert streak.sum() == pytest.approx(1.0, abs=0.02)  # near the middle the homography moves, only
        rows, columns = np.mgrid[0:60, 0:80]
        centre = np.array([(streak * rows).sum(), (streak * columns).sum()]) / streak.sum()
        assert centre == pytest.approx([30, 40], abs=0.05)
        spread = np.sqrt((streak * ((rows - 30) ** 2 + (columns - 40) ** 2)).sum())
        # An even streak of 10 px has a deviation of 10 / sqrt(12); the interpolation adds half a pixel.
        assert spread == pytest.approx(10 / np.sqrt(12), abs=0.2)


def test_what_is_even_stays_even_up_to_the_border() -> None:
    even = np.full((60, 80, 3), 0.3, np.float32)
    assert np.allclose(ShakeConfig(share=1.0, length_px=25.0).blur(even, CAMERA, 0), 0.3, atol=1e-5)


def test_a_frame_without_jerk_is_untouched() -> None:
    radiance = np.random.default_rng(0).random((60, 80, 3))
    assert ShakeConfig().blur(radiance, CAMERA, 0) is radiance
    assert ShakeConfig(share=1.0, length_px=0.0).blur(radiance, CAMERA, 0) is radiance


def test_the_film_tells_which_frames_are_shaken_and_only_those_are(small_rig: Rig) -> None:
    shaky = replace(small_rig, config=replace(small_rig.config, shake=ShakeConfig(share=0.3, seed=1)))
    seen = set()
    for plain, shaken in zip(small_rig.frames(), shaky.frames(), strict=True):
        assert not plain.truth.shaken
        seen.add(shaken.truth.shaken)
        assert np.array_equal(plain.rgb, shaken.rgb) != shaken.truth.shaken
        if plain.truth.index == 9:
            break
    assert seen == {False, True}


@pytest.mark.parametrize("wrong", [{"share": 1.2}, {"length_px": -1.0}, {"share": float("nan")}])
def test_a_shake_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ShakeConfig(**wrong)
