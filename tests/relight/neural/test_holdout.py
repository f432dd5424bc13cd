"""Held-out frames are pairs of a lit frame and an unlit neighbour, spread over the capture."""

from itertools import pairwise

import pytest
from analytic_scene import arc

from relight.neural.holdout import held_out
from relight.scene import View


def views(flags):
    cameras = arc(count=len(flags))
    return [View(10 + k, camera, flag) for k, (camera, flag) in enumerate(zip(cameras, flags, strict=True))]


def test_of_a_capture_as_long_as_the_papers_five_pairs_are_held_out():
    fitted, checked = held_out(views([1, 0, 0, 0, 0] * 25))
    assert len(checked) == 10
    assert len(fitted) == 115
    assert not {view.index for view in fitted} & {view.index for view in checked}
    lit = [view.index for view in checked if view.flash == 1]
    assert len(lit) == 5
    assert min(b - a for a, b in pairwise(lit)) >= 20
    for first, second in zip(checked[::2], checked[1::2], strict=True):
        assert (first.flash, second.flash) == (1, 0)
        assert abs(first.index - second.index) == 1


@pytest.mark.parametrize(("lit", "pairs"), [(0, 0), (4, 0), (5, 1), (15, 3), (60, 5)])
def test_of_few_lit_frames_fewer_are_spared(lit, pairs):
    _, checked = held_out(views([1] * lit + [0] * 30))
    assert len(checked) == 2 * pairs


def test_without_unlit_frames_lit_ones_are_held_out_alone():
    fitted, checked = held_out(views([1] * 10))
    assert [view.flash for view in checked] == [1, 1]
    assert len(fitted) == 8
    fitted, checked = held_out(views([1] * 10 + [0]))
    assert len([view for view in fitted if view.flash == 0]) == 1
