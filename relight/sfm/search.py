"""The state of a search for poses, and its steps: features, matches, one reconstruction from them."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from capture.errors import SessionError
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.errors import GeometryError
from relight.sfm.attempts import Outcome, attempt, match_pairs, verify_pairs
from relight.sfm.config import SfmConfig
from relight.sfm.features import Recipe
from relight.sfm.lenses import Lens, colmap_camera
from relight.sfm.mapping import LEAST_FRAMES
from relight.sfm.markers import MarkerFinder
from relight.sfm.matching import Pair
from relight.sfm.pairs import choose_pairs
from relight.sfm.pictures import grey_radiance
from relight.sfm.screening import choose_keyframes
from relight.sfm.survey import Look, survey
from relight.stages import Progress

STAGE = "poses"
_TRIED_FOR_MARKERS = 8  # frames


@dataclass(frozen=True)
class Way:
    """One rung of the ladder."""

    name: str
    recipe: Recipe
    wide: bool = False
    global_method: bool = False


@dataclass(eq=False)
class Search:
    """What is known while the ladder is climbed."""

    session: Session
    records: Sequence[FrameRecord]
    config: SfmConfig
    lenses: dict[tuple[int, int], Lens]
    finder: MarkerFinder
    threads: int
    progress: Progress
    looks: list[Look] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    kept: list[int] = field(default_factory=list)
    left_out: dict[int, str] = field(default_factory=dict)
    pairs: list[Pair] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    prepared: tuple[Recipe, bool] | None = None

    @property
    def mapped(self) -> list[Look]:
        """The keyframes."""
        return [self.looks[i] for i in self.kept]


def prepare(search: Search, way: Way) -> None:
    """Features, keyframes and matches of a way."""
    config, progress = search.config, search.progress
    since_s = time.perf_counter()
    if search.finder.board is None and not search.finder.dictionaries and not search.looks:
        search.finder.choose(_some_greys(search))
    search.looks, search.refused = survey(
        search.session,
        search.records,
        way.recipe,
        config,
        search.finder,
        search.threads,
        lambda share: progress(STAGE, 0.25 * share),
    )
    since_s = _clock(search, "features", since_s)
    if len(search.looks) < LEAST_FRAMES:
        why = next(iter(search.refused.values()), "none was given")
        raise GeometryError(
            f"Only {len(search.looks)} of {len(search.records)} frames can be read (needed: {LEAST_FRAMES}): "
            f"{why.rstrip('.')}."
        )
    search.kept, search.left_out = choose_keyframes(search.looks, config.max_keyframes)
    if len(search.kept) < LEAST_FRAMES:
        raise GeometryError(
            f"All {len(search.looks)} frames show the same view, from which no depth follows; film a sweep "
            "around the head."
        )
    mapped = search.mapped
    chosen = choose_pairs(
        [look.features.descriptors for look in mapped],
        [look.record.flash == 1 for look in mapped],
        wide=way.wide,
        seed=config.seed,
    )
    search.pairs = match_pairs(
        mapped, chosen, search.threads, lambda share: progress(STAGE, 0.25 + 0.25 * share)
    )
    search.prepared = (way.recipe, way.wide)
    _clock(search, "matches", since_s)


def solve(
    search: Search,
    way: Way,
    keep: Sequence[NDArray[np.bool_]] | None,
    lens: Mapping[tuple[int, int], pycolmap.Camera] | None = None,
) -> tuple[Outcome, dict[str, Any]]:
    """One reconstruction from what `prepare` left, and numbers about it for the report.

    Args:
        search: Its features and matches.
        way: How to map.
        keep: For each keyframe [N] bool, the features to use; None = all.
        lens: COLMAP's cameras by size, to be held fixed; None = as the session knows them.
    """
    mapped, config = search.mapped, search.config
    since_s = time.perf_counter()
    known = lens is not None or all(start.known for start in search.lenses.values())
    refine = not known or (config.refine_intrinsics and lens is None)
    cameras: dict[tuple[int, int], pycolmap.Camera] = {}
    for look in mapped:
        if look.size not in cameras and lens is None:
            start = search.lenses[look.record.width, look.record.height]
            cameras[look.size] = colmap_camera(start, look.size, refine, len(cameras) + 1)
        elif look.size not in cameras and lens is not None and look.size in lens:
            cameras[look.size] = copy.deepcopy(lens[look.size])
            cameras[look.size].has_prior_focal_length = True
    pairs = verify_pairs(mapped, cameras, search.pairs, keep, config, search.threads)
    since_s = _clock(search, "verification", since_s)
    search.progress(STAGE, 0.6)
    outcome = attempt(
        mapped,
        cameras,
        pairs,
        refine_lens=refine,
        free_model=not known,
        global_method=way.global_method,
        config=config,
        threads=search.threads,
    )
    _clock(search, "mapping", since_s)
    search.progress(STAGE, 0.9)
    about: dict[str, Any] = {"registered": outcome.registered, "pieces": list(outcome.pieces)}
    if outcome.assessment is not None:
        about |= outcome.assessment.numbers
    if outcome.complaints:
        about["complaints"] = list(outcome.complaints)
    return outcome, about


def _some_greys(search: Search) -> list[NDArray[np.float32]]:
    """A few frames spread over the session, to see which markers there are."""
    greys = []
    count = min(_TRIED_FOR_MARKERS, len(search.records))
    for position in np.unique(np.linspace(0, len(search.records) - 1, count).astype(int)):
        record = search.records[position]
        if record.file is None:
            continue
        try:
            radiance = search.session.load_radiance(record)
        except SessionError:
            continue
        greys.append(grey_radiance(radiance, search.config.max_side_px)[0])
    return greys


def _clock(search: Search, name: str, since_s: float) -> float:
    now_s = time.perf_counter()
    search.seconds[name] = search.seconds.get(name, 0.0) + now_s - since_s
    return now_s
