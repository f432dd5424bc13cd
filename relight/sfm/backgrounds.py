"""What to do about a background that does not stand still with the head."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from relight.alignment import align_cameras, pose_errors
from relight.errors import GeometryError
from relight.sfm.attempts import Outcome
from relight.sfm.motions import still_features, tracked_shares
from relight.sfm.search import Search, Way, prepare, solve
from relight.sfm.sparse import Sparse
from relight.sfm.subject import subject_features
from relight.sfm.world import look_point

# A reconstruction holds a smaller share of the matches on skin than on a wall, also where nothing moved.
_PARTED = 0.75  # one side's share over the other's, below which the head alone is asked
_HOLDS = 0.5  # share of a side's matches from which on its motion is that of the reconstruction
_TORN = 0.5  # below which the head moved, even if it cannot be asked
_SAME_ROTATION_DEG = 1.0  # median, between the poses by everything and those by the head alone
_SAME_PLACE = 0.04  # of the distance
_LEAST_MATCHES = 300  # on either side, to judge by
_ENOUGH = 0.9  # share of the keyframes
_MORE_HELD = 0.1  # share of the matches on the head
_LARGER_ERROR = 1.8

_PLAIN = (
    "The background shows next to nothing to hold on to, so the poses rest on the head alone and may be off "
    "by degrees; shelves, pictures or a few printed markers about the head (--marker-side) make them sure."
)


def follow_the_head(search: Search, way: Way) -> tuple[Outcome, dict[str, Any], tuple[str, ...]]:
    """Tries one way, and the head alone where the background moves on its own.

    Returns:
        The outcome, numbers about it for the report, and sentences for the user.

    Raises:
        GeometryError: the background is to be ignored, but nothing tells it from the head.
    """
    if search.prepared != (way.recipe, way.wide):
        prepare(search, way)
    mapped, config = search.mapped, search.config
    if config.background == "static":
        outcome, about = solve(search, way, None)
        return outcome, about | {"features_of": "everything"}, ()
    subject = subject_features(mapped)
    if config.background == "ignore":
        if subject is None:
            raise GeometryError(
                "The background is to be ignored, but neither masks nor the flash tell it from the head; "
                "give masks, keep a metre between head and wall, or set the background to auto."
            )
        outcome, about = solve(search, way, subject)
        return outcome, about | {"features_of": "subject"}, ()
    still = still_features(mapped, search.pairs)
    if still is not None:
        moving = [~flags for flags in still]
        outcome, about = solve(search, way, moving)
        warning = (
            "The background stands still in the pictures while the head turns: only what moves was used."
        )
        return outcome, about | {"features_of": "what moves"}, (warning,)
    outcome, about = solve(search, way, None)
    about |= {"features_of": "everything"}
    whole = outcome.sparse
    if subject is None or whole is None:
        return outcome, about, ()
    on, off, matches_on, matches_off = tracked_shares(
        whole, mapped, outcome.pairs, subject, outcome.cameras, config.seed
    )
    about |= {"tracked_on_subject": on, "tracked_off_subject": off, "matches_on_subject": matches_on}
    if matches_on < _LEAST_MATCHES or matches_off < _LEAST_MATCHES:
        return outcome, about, (_PLAIN,) if matches_off < _LEAST_MATCHES else ()
    parted = min(on, off) < min(_PARTED * max(on, off), _HOLDS)
    if not parted and outcome.usable:
        return outcome, about, ()
    # With the lens that everything gave: a short arc of the head alone does not tell the focal length, and
    # the two could not be compared.
    comparable = outcome.usable and len(outcome.cameras) == len({look.size for look in mapped})
    alone, about_alone = solve(search, way, subject, outcome.cameras if comparable else None)
    about |= {"alone": about_alone}
    if (
        alone.sparse is None
        or not alone.usable
        or alone.registered < min(_ENOUGH * len(mapped), outcome.registered)
    ):
        if on < _TORN * off:
            complaint = (
                f"two motions: {100 * off:.0f} % of the matches on the background fit it, but of those on "
                f"the head only {100 * on:.0f} %; it moved against the room and has too few features alone"
            )
            outcome = replace(outcome, complaints=(*outcome.complaints, complaint))
        return outcome, about, ()
    if outcome.usable:
        held, _, _, _ = tracked_shares(alone.sparse, mapped, alone.pairs, subject, alone.cameras, config.seed)
        about |= {"tracked_on_subject_alone": held}
        if same_motion(whole, alone.sparse) or not _is_better(whole, on, alone.sparse, held):
            return outcome, about, ()
    if comparable:
        freed, about_alone = solve(search, way, subject)
        if freed.usable and freed.registered >= alone.registered:
            alone, about["alone"] = freed, about_alone
    warning = "The head moves against the background: only features on the head were used."
    return alone, about | {"features_of": "subject"}, (warning,)


def _is_better(whole: Sparse, on: float, alone: Sparse, held: float) -> bool:
    """Whether the head alone tells another motion, and tells it truly.

    A head alone is small and seen from afar: nearly the same pictures come of it turned inside out and moving
    the other way, at the price of larger errors and fewer matches held. What is true of it holds more.
    """
    error, alone_error = (float(np.median(sparse.error_px)) for sparse in (whole, alone))
    return held > on + _MORE_HELD and alone_error < _LARGER_ERROR * error


def same_motion(first: Sparse, second: Sparse) -> bool:
    """Whether two reconstructions of the same frames agree on how the camera moved."""
    try:
        similarity = align_cameras(first.cameras, second.cameras)
    except GeometryError:  # too few cameras in common, or none that moved
        return False
    errors = pose_errors(first.cameras, second.cameras, similarity)
    centres = np.array([camera.centre_world for camera in second.cameras.values()])
    axes = np.array([camera.cam_from_world[2, :3] for camera in second.cameras.values()])
    distance = np.median(np.linalg.norm(centres - look_point(centres, axes, second.points), axis=1))
    return bool(
        np.median(errors.rotation_deg) < _SAME_ROTATION_DEG
        and np.median(errors.centre) < _SAME_PLACE * distance
    )
