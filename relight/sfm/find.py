"""Poses from a session's frames alone: what is tried, in which order, and what is believed."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.calibration import session_calibration
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.errors import GeometryError
from relight.sfm.attempts import Outcome
from relight.sfm.backgrounds import follow_the_head
from relight.sfm.config import PoseResult, SfmConfig
from relight.sfm.exif import focal_length_px
from relight.sfm.explain import all_flat, explain
from relight.sfm.features import Recipe
from relight.sfm.lenses import Lens, starting_lens
from relight.sfm.mapping import LEAST_FRAMES
from relight.sfm.markers import Board, MarkerFinder
from relight.sfm.result import make_result
from relight.sfm.search import STAGE, Search, Way, prepare
from relight.stages import Progress, no_progress

logger = logging.getLogger(__name__)

_ENOUGH = 0.9  # share of the keyframes with which no other way is tried
_EXIF_BYTES = 1 << 17


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
    search = Search(
        session,
        records,
        config,
        _lenses(session, records),
        MarkerFinder(board),
        config.threads or (os.cpu_count() or 1),
        progress,
    )
    started_s, started_cpu_s = time.perf_counter(), time.process_time()
    outcomes: list[tuple[Way, Outcome, dict[str, Any], tuple[str, ...]]] = []
    for way in _ladder(config):
        outcome, about, warnings = follow_the_head(search, way)
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
        prepare(search, best[0])  # features are numbered anew in each way
    search.seconds["all"] = time.perf_counter() - started_s
    search.seconds["processor"] = time.process_time() - started_cpu_s
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
        raise GeometryError(explain(search.looks, [best[1]], search.mapped, len(result.cameras)))
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
    progress(STAGE, 1.0)
    warnings = (*best[3], *_warnings(search, missing), *result.warnings)
    return replace(result, report=report, warnings=warnings)


def _ladder(config: SfmConfig) -> list[Way]:
    usual = Recipe("local", 0.01, config.max_features)
    fine = Recipe("local", 0.003, int(1.5 * config.max_features))
    tiles = Recipe("clahe", 0.004, int(1.5 * config.max_features))
    return [
        Way("usual", usual),
        Way("weaker features, more pairs", fine, wide=True),
        Way("equalised pictures, more pairs", tiles, wide=True),
        Way("global mapping", fine, wide=True, global_method=True),
    ]


def _lenses(session: Session, records: Sequence[FrameRecord]) -> dict[tuple[int, int], Lens]:
    """What is known of the lens, by the frames' size."""
    calibrated = session_calibration(session).intrinsics
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


def _missing(search: Search, result: PoseResult) -> dict[int, str]:
    """Frames without a pose and why."""
    reasons = dict(search.refused)
    reasons |= {int(index): why for index, why in result.report["not_resected"].items()}
    for record in search.records:
        if record.index not in result.cameras and record.index not in reasons:
            reasons[record.index] = "it fits no other frame"
    return {index: why for index, why in reasons.items() if index not in result.cameras}


def _warnings(search: Search, missing: dict[int, str]) -> list[str]:
    if not missing:
        return []
    index, why = next(iter(sorted(missing.items())))
    return [
        f"{len(missing)} of {len(search.records)} frames have no pose and are not used (frame {index}: "
        f"{why.rstrip('.')})."
    ]
