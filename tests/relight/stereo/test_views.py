import numpy as np
from ball_scene import camera_at

from relight.stereo.views import choose_sources, directions_from, spread_out


def circle(step):
    return {i: camera_at(step * i, str(i)) for i in range(20)}


def angles(chosen, step, reference):
    return sorted(step * (index - reference) for index in chosen)


def test_sources_lie_on_both_sides_at_about_the_wanted_angles():
    cameras = circle(2.0)
    chosen = choose_sources(10, cameras, list(cameras), np.zeros(3), (4.0, 8.0), 20.0)
    assert angles(chosen, 2.0, 10) == [-8.0, -4.0, 4.0, 8.0]


def test_at_the_end_of_the_path_all_are_on_one_side():
    cameras = circle(2.0)
    chosen = choose_sources(0, cameras, list(cameras), np.zeros(3), (4.0, 8.0), 20.0)
    assert len(chosen) == 4
    assert 0 not in chosen
    assert len(set(chosen)) == 4


def test_nothing_is_chosen_from_too_far_or_from_no_one():
    cameras = circle(15.0)
    assert choose_sources(3, cameras, list(cameras), np.zeros(3), (4.0, 8.0), 12.0) == []
    assert choose_sources(3, cameras, [3], np.zeros(3), (4.0, 8.0), 20.0) == []


def test_references_are_spread_evenly_and_reach_both_ends():
    directions = directions_from(np.zeros(3), [camera_at(a, "c") for a in np.linspace(-80, 80, 81)])
    chosen = spread_out(directions, 11)
    assert chosen[0] == 0
    assert chosen[-1] == 80
    assert max(np.diff(chosen)) <= 16  # twice the even spacing of 8: farthest point sampling halves gaps
    assert spread_out(directions[:4], 11) == [0, 1, 2, 3]
