"""Tensors are made once while there is room, and again when they were given up."""

import torch

from relight.neural.kept import KeptTensors


def test_a_tensor_is_made_once_while_there_is_room():
    made = []
    kept = KeptTensors(lambda n: made.append(n) or torch.full((4,), float(n)), room_bytes=48)
    for number in (0, 1, 2, 0, 1, 2):
        assert float(kept[number][0]) == number
    assert made == [0, 1, 2]


def test_the_one_not_used_for_longest_makes_room():
    made = []
    kept = KeptTensors(lambda n: made.append(n) or torch.zeros(4), room_bytes=40)
    for number in (0, 1, 0, 2, 0, 1):
        kept[number]
    assert made == [0, 1, 2, 1]


def test_a_tensor_larger_than_the_room_is_kept_alone():
    made = []
    kept = KeptTensors(lambda n: made.append(n) or torch.zeros(100), room_bytes=1)
    for number in (0, 0, 1, 1):
        kept[number]
    assert made == [0, 1]
