"""Matches and pairs: the same feature again, the same place again."""

import numpy as np
import pytest

from relight.sfm.features import Features
from relight.sfm.matching import match_descriptors, match_features
from relight.sfm.motions import still_features
from relight.sfm.pairs import choose_pairs, global_likeness
from relight.sfm.screening import blurred_frames, choose_keyframes, same_place


def described(count, seed=0):
    raw = np.random.default_rng(seed).gamma(0.6, 1.0, (count, 128))
    return np.minimum(np.rint(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))), 255).astype(np.uint8)


def test_matches_are_found_in_any_order_and_nothing_else_is():
    first = described(200)
    order = np.random.default_rng(1).permutation(200)
    second = np.concatenate([first[order[:150]], described(80, seed=2)])
    matches = match_descriptors(first, second)
    assert len(matches) == 150
    assert np.array_equal(order[matches[:, 1]], matches[:, 0])


def test_repeated_texture_does_not_match():
    first = described(50)
    assert len(match_descriptors(first, np.concatenate([first, first]))) == 0


@pytest.mark.parametrize("count", [0, 1])
def test_frames_without_features_do_not_match(count):
    assert match_descriptors(described(count), described(30)).shape == (0, 2)


def test_printed_corners_match_by_their_labels():
    def features(labels):
        return Features(
            np.zeros((len(labels), 2)),
            np.zeros((0, 128), np.uint8),
            np.array(labels),
            np.zeros((len(labels), 3), np.float32),
        )

    matches = match_features(features([-1, 7, 9, -1]), features([-1, 9, 3, 7]))
    assert sorted(matches.tolist()) == [[1, 3], [2, 1]]


def test_few_frames_are_all_compared():
    assert len(choose_pairs([described(10)] * 10, [False] * 10)) == 45
    assert choose_pairs([], []) == []


def test_many_frames_are_compared_along_the_path_and_where_it_closes():
    random = np.random.default_rng(0)
    places = [described(60, seed=k) for k in range(60)]
    loop = [*places, *places[:6]]  # the path comes back to its beginning
    loop = [d[random.permutation(60)] for d in loop]
    pairs = choose_pairs(loop, [k % 5 == 0 for k in range(66)])
    assert len(pairs) < 66 * 12
    assert {(k, k + 1) for k in range(65)} <= set(pairs)
    assert {(k, 60 + k) for k in range(6)} <= set(pairs)
    assert {(0, 5), (5, 10)} <= set(pairs)  # lit frames with lit frames
    assert len(choose_pairs(loop, [False] * 66, wide=True)) > len(pairs)


def test_frames_without_features_are_like_no_other():
    likeness = global_likeness([described(80), described(80), np.zeros((0, 128), np.uint8)], 0)
    assert likeness[0, 1] > likeness[0, 2] == -1


def test_a_blurred_frame_stands_out_among_its_neighbours():
    sharpness = 0.5 + 0.1 * np.sin(np.arange(40) / 6)
    sharpness[[7, 21]] *= 0.4
    assert blurred_frames(sharpness) == [7, 21]
    assert blurred_frames([0.5]) == []
    assert blurred_frames([0.5] * 8) == []


def test_frames_from_one_place_are_kept_once_for_each_light(scene, make_arc):
    points = scene()
    camera, other = make_arc(2, 0, 5)
    still = [points.look(camera, k, flash=int(k in (1, 3))) for k in range(4)]
    moved = points.look(other, 4)
    assert same_place(still[0], still[2])
    assert not same_place(still[0], moved)
    kept, left_out = choose_keyframes([*still, moved], 100)
    assert kept == [0, 1, 4]
    assert set(left_out) == {2, 3}


def test_more_keyframes_than_wanted_are_thinned_out_evenly(scene, make_arc):
    looks = scene(head_points=60, room_points=80).looks(make_arc(30))
    kept, left_out = choose_keyframes(looks, 15)
    assert 12 <= len(kept) <= 15
    assert max(np.diff(kept)) <= 4
    assert sorted([*kept, *left_out]) == list(range(30))
    assert {k for k in range(30) if looks[k].record.flash} & set(kept)


def test_a_background_that_moves_is_not_taken_for_a_still_one(scene, make_arc):
    from relight.sfm.attempts import match_pairs

    looks = scene(head_points=80, room_points=150).looks(make_arc(10))
    pairs = match_pairs(looks, choose_pairs([x.features.descriptors for x in looks], [False] * 10), 1, print)
    assert still_features(looks, pairs) is None
