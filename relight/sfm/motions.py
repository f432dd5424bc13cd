"""A head that moves in its room: which matches to believe when two motions are in the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from relight.sfm.matching import Pair, verify
from relight.sfm.sparse import Sparse
from relight.sfm.survey import Look

_FAR = 5  # frames apart in the order of capture
_STILL = 0.002  # motion, share of the longer side: a pixel of 512
_MOVING = 0.008
_LEAST_STILL = 0.15  # of a pair's matches; the head may be a few among a wall's thousand
_LEAST_MATCHES = 10
_LEAST_PAIRS = 0.5  # share of the far pairs
_ASKED = 60  # far pairs of which each side's motion is found
_ERROR_PX = 3.0


def still_features(looks: Sequence[Look], pairs: Sequence[Pair]) -> list[NDArray[np.bool_]] | None:
    """Features of a background that stands still in the picture while something else moves.

    So it is when the camera stands on a tripod and the person turns on a chair. A camera that moves keeps
    nothing in its place from one end of its path to the other.

    Args:
        looks: In the order of capture.
        pairs: Compared frames with all their matches.

    Returns:
        For each frame [N] bool; None where no such background is.
    """
    flags = [np.zeros(len(look.features), bool) for look in looks]
    far = both = 0
    for pair in pairs:
        if pair.second - pair.first < _FAR or len(pair.matches) < 2 * _LEAST_MATCHES:
            continue
        motion = _motion(looks, pair)
        still, moving = motion < _STILL, motion > _MOVING
        far += 1
        enough_still = still.sum() >= max(_LEAST_MATCHES, _LEAST_STILL * len(motion))
        both += int(enough_still and moving.sum() >= _LEAST_MATCHES)
        flags[pair.first][pair.matches[still, 0]] = True
        flags[pair.second][pair.matches[still, 1]] = True
    if not far or both < _LEAST_PAIRS * far:
        return None
    return flags


def tracked_shares(
    sparse: Sparse,
    looks: Sequence[Look],
    pairs: Sequence[Pair],
    subject: Sequence[NDArray[np.bool_]],
    cameras: Mapping[tuple[int, int], pycolmap.Camera],
    seed: int,
) -> tuple[float, float, int, int]:
    """How much of what moves as one on the subject, and of what does so off it, the reconstruction holds.

    Matches of frames far apart are asked, each side by a motion of its own: there, two motions have parted so
    much that no point can be found under both.

    Args:
        sparse: The reconstruction.
        looks: The frames that were mapped.
        pairs: Compared frames with all their matches.
        subject: For each frame [N] bool.
        cameras: COLMAP's cameras by size.
        seed: Of the robust estimates.

    Returns:
        Share of the matches that agree on a motion whose two ends are one point of the reconstruction, on the
        subject and on the background; and the numbers of such matches.
    """
    points = {i: sparse.point_of_feature(i, len(looks[i].features)) for i in sparse.cameras}
    far = [p for p in pairs if p.second - p.first >= _FAR - 1 and p.first in points and p.second in points]
    chosen = sorted({round(k) for k in np.linspace(0, len(far) - 1, min(_ASKED, len(far)))})
    kept, total = [0, 0], [0, 0]
    for pair in (far[k] for k in chosen):
        i, j = pair.first, pair.second
        lenses = (cameras[looks[i].size], cameras[looks[j].size])
        on = subject[i][pair.matches[:, 0]] & subject[j][pair.matches[:, 1]]
        off = ~subject[i][pair.matches[:, 0]] & ~subject[j][pair.matches[:, 1]]
        for side, flag in enumerate((on, off)):
            geometry = verify(
                looks[i].features, looks[j].features, lenses, pair.matches[flag], _ERROR_PX, seed
            )
            if geometry is not None:
                a, b = np.asarray(geometry.inlier_matches).T
                kept[side] += int(((points[i][a] >= 0) & (points[i][a] == points[j][b])).sum())
                total[side] += len(a)
    on_share, off_share = (k / t if t else 0.0 for k, t in zip(kept, total, strict=True))
    return on_share, off_share, total[0], total[1]


def _motion(looks: Sequence[Look], pair: Pair) -> NDArray[np.float64]:
    """[M] how far each match moved, share of the longer side."""
    first = looks[pair.first].features.places_px[pair.matches[:, 0]]
    second = looks[pair.second].features.places_px[pair.matches[:, 1]]
    return np.asarray(np.linalg.norm(first - second, axis=1) / max(looks[pair.first].size))
