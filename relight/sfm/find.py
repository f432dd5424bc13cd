"""Poses from a session's frames alone: what is tried, in which order, and what is believed."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from calib.calibration import load_calibration
from capture.errors import SessionError
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.errors import GeometryError
from relight.sfm.attempts import Outcome, attempt, match_pairs, verify_pairs
from relight.sfm.config import PoseResult, SfmConfig
from relight.sfm.exif import focal_length_px
from relight.sfm.explain import all_flat, explain
from relight.sfm.features import Recipe
from relight.sfm.lenses import Lens, colmap_camera, starting_lens
from relight.sfm.mapping import LEAST_FRAMES
from relight.sfm.markers import Board, MarkerFinder
from relight.sfm.matching import Pair
from relight.sfm.motions import still_features, tracked_shares
from relight.sfm.pairs import choose_pairs
from relight.sfm.pictures import grey_radiance
from relight.sfm.result import make_result
from relight.sfm.screening import choose_keyframes
from relight.sfm.subject import subject_features
from relight.sfm.survey import Look, survey
from relight.stages import Progress, no_progress

logger = logging.getLogger(__name__)

_STAGE = "poses"
_ENOUGH = 0.9  # share of the keyframes with which no other way is tried
_TRIED_FOR_MARKERS = 8  # frames
_EXIF_BYTES = 1 << 17
_LEAST_KEPT = 0.5  # of the background's share of tracked matches that the subject's must reach
_LEAST_SUBJECT_MATCHES = 300


@dataclass(frozen=True)
class _Way:
    """One rung of the ladder."""

    name: str
    recipe: Recipe
    wide: bool = False
    global_method: bool = False


@dataclass(eq=False)
class _Search:
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


def find_poses(
    session: Session,
    records: Sequence[FrameRecord],
    config: SfmConfig | None = None,
    progress: Progress = no_progress,
) -> PoseResult:
    """Finds the cameras of a session's frames.

    Args:
        session: Read only.
        records: Frames that want a pose; in any order.
        config: Settings.
        progress: Told ("poses", share done).

    Returns:
        A pose for every frame that can have one; the report says why others have none.

    Raises:
        GeometryError: no reconstruction passed the checks; the sentence says what was seen and what to do.
    """
    config = config or SfmConfig()
    records = sorted(records, key=lambda record: record.index)
    if len(records) < LEAST_FRAMES:
        raise GeometryError(
            f"{len(records)} frames are too few to find poses from (needed: {LEAST_FRAMES}); film a sweep "
            "around the head, or give the poses."
        )
    try:
        board = Board.parse(config.board) if config.board else None
    except ValueError as cause:
        raise GeometryError(str(cause)) from cause
    search = _Search(
        session,
        records,
        config,
        _lenses(session, records),
        MarkerFinder(board),
        config.threads or (os.cpu_count() or 1),
        progress,
    )
    started_s = time.perf_counter()
    outcomes: list[tuple[_Way, Outcome, dict[str, Any], tuple[str, ...]]] = []
    for way in _ladder(config):
        outcome, about, warnings = _climb(search, way)
        outcomes.append((way, outcome, about, warnings))
        logger.info("poses, %s: %d of %d frames", way.name, outcome.registered, len(search.kept))
        if outcome.usable and outcome.registered >= _ENOUGH * len(search.kept):
            break
        if not outcome.usable and all_flat(outcome.pairs):
            break
    usable = [entry for entry in outcomes if entry[1].usable]
    best = max(usable, key=lambda entry: entry[1].registered, default=None)
    if best is None:
        raise GeometryError(explain(search.looks, [entry[1] for entry in outcomes], search.mapped))
    if search.prepared != (best[0].recipe, best[0].wide):
        _prepare(search, best[0])  # features are numbered anew in each way
    search.seconds["all"] = time.perf_counter() - started_s
    attempts = [{"way": way.name} | about for way, _, about, _ in outcomes]
    result = make_result(
        session.info["image"].get("rotation_deg", 0),
        search.looks,
        search.kept,
        best[1],
        search.lenses,
        config,
        board,
    )
    share = len(result.cameras) / len(records)
    if share < config.min_registered:
        raise GeometryError(
            f"Only {len(result.cameras)} of {len(records)} frames could be posed (needed: "
            f"{100 * config.min_registered:.0f} %). {explain(search.looks, [best[1]], search.mapped)}"
        )
    missing = _missing(search, result)
    report = {
        "frames": len(records),
        "registered": len(result.cameras),
        "keyframes": len(search.kept),
        "left_out": {str(search.looks[i].index): why for i, why in sorted(search.left_out.items())},
        "without_pose": {str(index): why for index, why in sorted(missing.items())},
        "median_features": float(np.median([len(look.features) for look in search.looks])),
        "pairs": len(best[1].pairs),
        "verified_pairs": sum(pair.verified for pair in best[1].pairs),
        "markers": list(search.finder.dictionaries),
        "attempts": attempts,
        **result.report,
        "seconds": {name: round(seconds, 3) for name, seconds in search.seconds.items()},
    }
    progress(_STAGE, 1.0)
    warnings = (*best[3], *_warnings(search, missing), *result.warnings)
    return replace(result, report=report, warnings=warnings)


def _ladder(config: SfmConfig) -> list[_Way]:
    usual = Recipe("local", 0.01, config.max_features)
    fine = Recipe("local", 0.003, int(1.5 * config.max_features))
    tiles = Recipe("clahe", 0.004, int(1.5 * config.max_features))
    return [
        _Way("usual", usual),
        _Way("weaker features, more pairs", fine, wide=True),
        _Way("equalised pictures, more pairs", tiles, wide=True),
        _Way("global mapping", fine, wide=True, global_method=True),
    ]


def _lenses(session: Session, records: Sequence[FrameRecord]) -> dict[tuple[int, int], Lens]:
    """What is known of the lens, by the frames' size."""
    calibrated = load_calibration(session.calibration_path).intrinsics
    lenses: dict[tuple[int, int], Lens] = {}
    for record in records:
        size = (record.width, record.height)
        if size not in lenses:
            lenses[size] = starting_lens(*size, calibrated, _exif_focal_px(session, record))
    return lenses


def _exif_focal_px(session: Session, record: FrameRecord) -> float | None:
    if record.file is None or not record.file.lower().endswith((".jpg", ".jpeg")):
        return None
    try:
        with (session.path / record.file).open("rb") as file:
            return focal_length_px(file.read(_EXIF_BYTES), record.width, record.height)
    except OSError:  # the survey says what is wrong with the file
        return None


def _prepare(search: _Search, way: _Way) -> None:
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
        lambda share: progress(_STAGE, 0.25 * share),
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
        mapped, chosen, search.threads, lambda share: progress(_STAGE, 0.25 + 0.25 * share)
    )
    search.prepared = (way.recipe, way.wide)
    _clock(search, "matches", since_s)


def _climb(search: _Search, way: _Way) -> tuple[Outcome, dict[str, Any], tuple[str, ...]]:
    """Tries one way, and the head alone where the background moves on its own."""
    if search.prepared != (way.recipe, way.wide):
        _prepare(search, way)
    mapped, config = search.mapped, search.config
    if config.background == "static":
        outcome, about = _solve(search, way, None)
        return outcome, about | {"features_of": "everything"}, ()
    subject = subject_features(mapped)
    if config.background == "ignore":
        if subject is None:
            raise GeometryError(
                "The background is to be ignored, but neither masks nor the flash tell it from the head; "
                "give masks, keep a metre between head and wall, or set the background to auto."
            )
        outcome, about = _solve(search, way, subject)
        return outcome, about | {"features_of": "subject"}, ()
    still = still_features(mapped, search.pairs)
    if still is not None:
        moving = [~flags for flags in still]
        outcome, about = _solve(search, way, moving)
        warning = (
            "The background stands still in the pictures while the head turns: only what moves was used."
        )
        return outcome, about | {"features_of": "what moves"}, (warning,)
    outcome, about = _solve(search, way, None)
    about |= {"features_of": "everything"}
    if subject is None or outcome.sparse is None:
        return outcome, about, ()
    on, off, matches_on, matches_off = tracked_shares(
        outcome.sparse, mapped, outcome.pairs, subject, outcome.cameras, config.seed
    )
    about |= {"tracked_on_subject": on, "tracked_off_subject": off, "matches_on_subject": matches_on}
    if matches_on < _LEAST_SUBJECT_MATCHES or matches_off < _LEAST_SUBJECT_MATCHES:
        return outcome, about, ()
    if on < _LEAST_KEPT * off or not outcome.usable:
        alone, about_alone = _solve(search, way, subject)
        about |= {"alone": about_alone}
        if alone.usable and alone.registered >= min(_ENOUGH * len(mapped), outcome.registered):
            warning = "The head moves in front of the background: only features on the head were used."
            return alone, about | {"features_of": "subject"}, (warning,)
        if on < _LEAST_KEPT * off:
            complaint = (
                f"two motions: {100 * off:.0f} % of the matches on the background fit it, but only "
                f"{100 * on:.0f} % of those on the head; the head moved against the room, and alone it has "
                "too few features"
            )
            outcome = replace(outcome, complaints=(*outcome.complaints, complaint))
    if off < _LEAST_KEPT * on:
        warning = (
            f"The background moves against the head: {100 * off:.0f} % of its matches fit the poses, of the "
            f"head's {100 * on:.0f} %."
        )
        return outcome, about, (warning,)
    return outcome, about, ()


def _solve(
    search: _Search, way: _Way, keep: Sequence[NDArray[np.bool_]] | None
) -> tuple[Outcome, dict[str, Any]]:
    mapped, config = search.mapped, search.config
    since_s = time.perf_counter()
    known = all(lens.known for lens in search.lenses.values())
    refine = not known or config.refine_intrinsics
    cameras: dict[tuple[int, int], pycolmap.Camera] = {}
    for look in mapped:
        if look.size not in cameras:
            lens = search.lenses[look.record.width, look.record.height]
            cameras[look.size] = colmap_camera(lens, look.size, refine, len(cameras) + 1)
    pairs = verify_pairs(mapped, cameras, search.pairs, keep, config, search.threads)
    since_s = _clock(search, "verification", since_s)
    search.progress(_STAGE, 0.6)
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
    search.progress(_STAGE, 0.9)
    about: dict[str, Any] = {"registered": outcome.registered, "pieces": list(outcome.pieces)}
    if outcome.assessment is not None:
        about |= outcome.assessment.numbers
    if outcome.complaints:
        about["complaints"] = list(outcome.complaints)
    return outcome, about


def _some_greys(search: _Search) -> list[NDArray[np.float32]]:
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


def _missing(search: _Search, result: PoseResult) -> dict[int, str]:
    """Frames without a pose and why."""
    reasons = dict(search.refused)
    reasons |= {int(index): why for index, why in result.report["not_resected"].items()}
    for record in search.records:
        if record.index not in result.cameras and record.index not in reasons:
            reasons[record.index] = "it fits no other frame"
    return {index: why for index, why in reasons.items() if index not in result.cameras}


def _warnings(search: _Search, missing: dict[int, str]) -> list[str]:
    if not missing:
        return []
    index, why = next(iter(sorted(missing.items())))
    return [
        f"{len(missing)} of {len(search.records)} frames have no pose and are not used (frame {index}: "
        f"{why.rstrip('.')})."
    ]


def _clock(search: _Search, name: str, since_s: float) -> float:
    now_s = time.perf_counter()
    search.seconds[name] = search.seconds.get(name, 0.0) + now_s - since_s
    return now_s
