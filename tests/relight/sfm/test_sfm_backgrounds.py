"""When the head alone is believed against everything."""

from types import SimpleNamespace

import numpy as np
import pytest

from relight.sfm.backgrounds import _is_better


def errors(px):
    return SimpleNamespace(error_px=np.full(10, px))


@pytest.mark.parametrize(
    ("alone_px", "held", "better"),
    [
        (0.25, 0.9, True),  # a head on a turning chair: the room's motion held three in ten of its matches
        (0.7, 0.9, False),  # nothing moved, and the head alone came out inside out
        (0.25, 0.35, False),  # another motion, but no truer
    ],
)
def test_only_a_truer_motion_of_the_head_replaces_that_of_everything(alone_px, held, better):
    assert _is_better(errors(0.2), 0.3, errors(alone_px), held) is better
