import numpy as np
import pytest

from capture.doctor.banding import find_banding

HEIGHT, WIDTH = 240, 160


@pytest.fixture
def frames():
    """Makes (lit, unlit) frames of a scene with texture, noise, and a wave of so many stripes."""

    def make(waves=0.0, depth=0.0, count=6, strength=0.2, seed=0):
        rng = np.random.default_rng(seed)
        scene = 0.3 + 0.3 * rng.random((HEIGHT, 1, 1)) + 0.2 * rng.random((HEIGHT, WIDTH, 1))
        lit, unlit = [], []
        for _ in range(count):
            phase = 2 * np.pi * (waves * np.arange(HEIGHT) / HEIGHT + rng.random())
            light = strength * (1 + depth * np.sin(phase))[:, None, None]
            noise = 0.004 * rng.standard_normal((2, HEIGHT, WIDTH, 3))
            lit.append((0.3 * scene + scene * light + noise[0]).astype(np.float32))
            unlit.append((0.3 * scene + noise[1]).astype(np.float32))
        return lit, unlit

    return make


@pytest.mark.parametrize(("waves", "depth"), [(7, 0.02), (23, 0.05), (60, 0.3)])
def test_stripes_are_found_with_their_number_and_depth(frames, waves, depth):
    found = find_banding(*frames(waves, depth))
    assert found.waves == pytest.approx(waves, abs=1)
    # Six phases at random leave the wave's power to about a fifth.
    assert found.depth == pytest.approx(depth, rel=0.25)


@pytest.mark.parametrize("seed", range(8))
def test_a_textured_scene_under_steady_light_has_none(frames, seed):
    found = find_banding(*frames(seed=seed))
    assert found is None or found.depth < 0.002


def test_too_few_frames_too_little_light_and_no_numbers_tell_nothing(frames):
    assert find_banding(*frames(20, 0.3, count=2)) is None
    assert find_banding(*frames(20, 0.3, strength=0.0)) is None
    lit, unlit = frames(20, 0.3)
    lit[0][:] = np.nan
    assert find_banding(lit, unlit) is None
    assert find_banding([], []) is None
