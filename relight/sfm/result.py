"""From a reconstruction that was believed to the result: every frame's pose, the world, the unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relight.sfm.attempts import Outcome
from relight.sfm.checks import path_jumps
from relight.sfm.config import PoseResult, SfmConfig
from relight.sfm.lenses import Lens
from relight.sfm.markers import Board, metres_per_unit
from relight.sfm.resection import resect_all
from relight.sfm.sparse import Sparse
from relight.sfm.survey import Look
from relight.sfm.world import TYPICAL_DISTANCE, canonical_world

_ROUNDS = 3
_ENOUGH_FAN_DEG = 30.0  # an arc of 12 degrees left an unknown focal length 2 % wrong


def make_result(
    rotation_deg: int,
    looks: Sequence[Look],
    kept: Sequence[int],
    outcome: Outcome,
    lenses: Mapping[tuple[int, int], Lens],
    config: SfmConfig,
    board: Board | None,
) -> PoseResult:
    """Poses the remaining frames, sets up the world and reports.

    Args:
        rotation_deg: Clockwise turn that shows the frames upright.
        looks: All frames that could be read, in the order of capture.
        kept: Positions in `looks` of those that were mapped.
        outcome: Usable.
        lenses: What was known before, by the frames' size.
        config: Settings.
        board: The ChArUco board, when one was looked for.
    """
    sparse = outcome.sparse
    assert sparse is not None
    resected, failed = resect_all(looks, kept, sparse, outcome.cameras, config.seed)
    mapped_cameras = {kept[position]: camera for position, camera in sparse.cameras.items()}
    for _ in range(_ROUNDS):  # one that is astray bends the path that its neighbours are judged by
        for astray in path_jumps(replace(sparse, cameras=mapped_cameras | resected)):
            if resected.pop(astray, None) is not None:
                failed[astray] = "the pose that its points agree on lies off the camera's path"
    by_position = mapped_cameras | resected
    mapped = [looks[i] for i in kept]
    unit = metres_per_unit(_corners(sparse, mapped), board, config.marker_side_m)
    cameras = [sparse.cameras[position] for position in sorted(sparse.cameras)]
    world = canonical_world(cameras, sparse.points, rotation_deg, None if unit is None else unit[0])
    found = {looks[i].index: world.camera(camera) for i, camera in sorted(by_position.items())}
    example = next(iter(found.values()))
    worked = mapped[min(sparse.cameras)]
    enlarged = worked.record.width / worked.size[0]
    assessment = outcome.assessment
    report: dict[str, Any] = {
        "mapped": len(sparse.cameras),
        "resected": len(resected),
        "not_resected": {str(looks[i].index): why for i, why in sorted(failed.items())},
        "lens_start": next(iter(lenses.values())).source,
        "lens_model": sparse.model,
        "lens_trials": [
            {"model": trial.model, "error_px": trial.error_px, "chosen": trial.chosen}
            for trial in outcome.trials
        ],
        "K": np.asarray(example.K).tolist(),
        "distortion": np.asarray(example.distortion).tolist(),
        "checks": {} if assessment is None else dict(assessment.numbers),
        "unit": "metres" if unit else "arbitrary",
    }
    source = (
        unit[1]
        if unit
        else f"none: the median distance from the cameras to what they look at is taken as {TYPICAL_DISTANCE}"
    )
    return PoseResult(
        cameras=found,
        points_world=world.points(sparse.points),
        colors=_colors(sparse, mapped),
        error_px=sparse.error_px * enlarged,
        track_length=sparse.track_length,
        metric=unit is not None,
        scale_source=source,
        report=report,
        warnings=(
            *_size_warning(unit is not None, config, board),
            *_lens_warning(outcome, lenses),
        ),
    )


def _size_warning(metric: bool, config: SfmConfig, board: Board | None) -> tuple[str, ...]:
    if metric or (board is None and config.marker_side_m is None):
        return ()
    what = "The ChArUco board was" if board is not None else "Markers of the stated size were"
    return (f"{what} not seen in enough frames to give the unit; the poses have none.",)


def _lens_warning(outcome: Outcome, lenses: Mapping[tuple[int, int], Lens]) -> tuple[str, ...]:
    if outcome.assessment is None or all(lens.known for lens in lenses.values()):
        return ()
    fan = outcome.assessment.numbers["fan_deg"]
    if fan >= _ENOUGH_FAN_DEG:
        return ()
    return (
        f"The cameras fan over {fan:.0f} degrees only, from which the focal length is not well known "
        f"(good from {_ENOUGH_FAN_DEG:.0f}); calibrate the camera, or walk farther around the head.",
    )


def _corners(sparse: Sparse, mapped: Sequence[Look]) -> dict[int, NDArray[np.float64]]:
    """Label to place of the printed corners that were reconstructed, those found as two points left out."""
    points: dict[int, set[int]] = {}
    for position, look in enumerate(mapped):
        labelled = np.flatnonzero(look.features.labels >= 0)
        if len(labelled) and position in sparse.cameras:
            point_of = sparse.point_of_feature(position, len(look.features))
            for feature in labelled[point_of[labelled] >= 0]:
                points.setdefault(int(look.features.labels[feature]), set()).add(int(point_of[feature]))
    return {label: sparse.points[next(iter(which))] for label, which in points.items() if len(which) == 1}


def _colors(sparse: Sparse, mapped: Sequence[Look]) -> NDArray[np.float32]:
    """[P, 3] mean linear radiance of each point, over the unlit frames where there are any that show it."""
    sums = np.zeros((2, len(sparse.points), 3))
    counts = np.zeros((2, len(sparse.points)))
    for position, look in enumerate(mapped):
        rows = sparse.observations[sparse.observations[:, 0] == position]
        lit = int(look.record.flash != 0)
        np.add.at(sums[lit], rows[:, 2], look.features.colors[rows[:, 1]])
        np.add.at(counts[lit], rows[:, 2], 1.0)
    chosen = np.where(counts[0] > 0, 0, 1)
    rows_of = np.arange(len(sparse.points))
    return np.asarray(sums[chosen, rows_of] / np.maximum(counts[chosen, rows_of], 1.0)[:, None], np.float32)
