"""One way of finding the poses, from matches to an adjusted reconstruction that was checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pycolmap
from numpy.typing import NDArray

from relight.sfm.adjustment import LensTrial, adjust, choose_lens
from relight.sfm.checks import Assessment, assess
from relight.sfm.config import SfmConfig
from relight.sfm.lenses import impossible_lens
from relight.sfm.mapping import map_frames
from relight.sfm.matching import Pair, match_features, verify
from relight.sfm.sparse import Sparse, sparse_of
from relight.sfm.survey import Look, in_order

VERIFY_ERROR_PX = 3.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one attempt gave.

    Attributes:
        pairs: All compared pairs, with what was verified of them.
        sparse: The largest reconstruction; None = COLMAP found no start.
        cameras: COLMAP's cameras by size at which frames were looked at, as refined.
        assessment: Of `sparse`.
        pieces: Numbers of frames in each reconstruction that came out, the largest first.
        trials: Lens models that were tried.
        complaints: Why it cannot be used as it is; none = it can.
    """

    pairs: list[Pair]
    sparse: Sparse | None
    cameras: dict[tuple[int, int], pycolmap.Camera]
    assessment: Assessment | None
    pieces: tuple[int, ...]
    trials: tuple[LensTrial, ...] = ()
    complaints: tuple[str, ...] = field(default=())

    @property
    def usable(self) -> bool:
        """Whether it passed every check."""
        return self.sparse is not None and not self.complaints

    @property
    def registered(self) -> int:
        """Frames with a pose."""
        return 0 if self.sparse is None else len(self.sparse.cameras)


def match_pairs(
    looks: Sequence[Look], pairs: Sequence[tuple[int, int]], threads: int, told: Callable[[float], None]
) -> list[Pair]:
    """Compares pairs of frames by what they look like."""

    def match(pair: tuple[int, int]) -> Pair:
        found = match_features(looks[pair[0]].features, looks[pair[1]].features)
        return Pair(pair[0], pair[1], found, None)

    compared = []
    for done, pair in enumerate(in_order(match, pairs, threads)):
        compared.append(pair)
        told((done + 1) / len(pairs))
    return compared


def verify_pairs(
    looks: Sequence[Look],
    cameras: Mapping[tuple[int, int], pycolmap.Camera],
    pairs: Sequence[Pair],
    keep: Sequence[NDArray[np.bool_]] | None,
    config: SfmConfig,
    threads: int,
) -> list[Pair]:
    """Finds the motion of each pair, from the features to keep ([N] bool for each frame; None = all)."""

    def check(pair: Pair) -> Pair:
        a, b = looks[pair.first], looks[pair.second]
        matches = pair.matches
        if keep is not None and len(matches):
            matches = matches[keep[pair.first][matches[:, 0]] & keep[pair.second][matches[:, 1]]]
        lenses = (cameras[a.size], cameras[b.size])
        geometry = verify(a.features, b.features, lenses, matches, VERIFY_ERROR_PX, config.seed)
        return Pair(pair.first, pair.second, pair.matches, geometry)

    return list(in_order(check, pairs, threads))


def attempt(
    looks: Sequence[Look],
    cameras: Mapping[tuple[int, int], pycolmap.Camera],
    pairs: Sequence[Pair],
    *,
    refine_lens: bool,
    free_model: bool,
    global_method: bool,
    config: SfmConfig,
    threads: int,
) -> Outcome:
    """Maps, adjusts and checks.

    Args:
        looks: Frames to map.
        cameras: COLMAP's cameras to start from, by size.
        pairs: Verified.
        refine_lens: Whether focal length and distortion are refined.
        free_model: Whether the lens model may be exchanged for a simpler or richer one.
        global_method: COLMAP's global mapper instead of the incremental one.
        config: Settings.
        threads: For COLMAP.
    """
    done = list(pairs)
    models = map_frames(
        looks,
        cameras,
        done,
        refine_lens=refine_lens,
        global_method=global_method,
        threads=threads,
        seed=config.seed,
    )
    pieces = tuple(model.num_reg_images() for model in models)
    if not models:
        return Outcome(done, None, dict(cameras), None, ())
    model = models[0]
    adjust(model, refine_lens=refine_lens, threads=threads)
    trials: list[LensTrial] = []
    if free_model:
        model, trials = choose_lens(model, threads)
    sparse = sparse_of(model, looks)
    assessment = assess(sparse, looks, done)
    if assessment.jumps and not assessment.complaints:  # a few frames astray: they are posed again later
        sparse = sparse.without(assessment.jumps)
    complaints = list(assessment.complaints)
    refined = {
        size: model.cameras[camera.camera_id]
        for size, camera in cameras.items()
        if camera.camera_id in model.cameras
    }
    if refine_lens:
        complaints += [text for camera in refined.values() if (text := impossible_lens(camera))]
    return Outcome(done, sparse, refined, assessment, pieces, tuple(trials), tuple(complaints))
