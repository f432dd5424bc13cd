"""One pass over a session's frames: features, sharpness and a thumbnail of each, a frame at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from capture.errors import SessionError
from capture.frame_record import FrameRecord
from capture.session import Session
from relight.sfm.config import SfmConfig
from relight.sfm.features import Features, Recipe, colors_at, detect_features
from relight.sfm.markers import MarkerFinder
from relight.sfm.pictures import feature_picture, grey_radiance, sharpness, small_picture

_LEAST_FINITE = 0.5  # share of a frame's pixels
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Look:
    """What is kept of a frame.

    Attributes:
        record: Its line in the log.
        size: (width, height) at which it was looked at, pixels.
        features: Found in it, in pixels of that size.
        sharpness: Comparable between frames of a session.
        small: [h, w] grey radiance at 64 pixels.
        subject: [N] bool, which features are on the subject by the session's mask; None = no mask.
    """

    record: FrameRecord
    size: tuple[int, int]
    features: Features
    sharpness: float
    small: NDArray[np.float32]
    subject: NDArray[np.bool_] | None

    @property
    def index(self) -> int:
        """The frame's number in the session."""
        return self.record.index


def in_order(function: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[R]:
    """Results of a function in the order of its items, computed by several threads."""
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)


def survey(
    session: Session,
    records: Sequence[FrameRecord],
    recipe: Recipe,
    config: SfmConfig,
    finder: MarkerFinder,
    threads: int,
    told: Callable[[float], None],
) -> tuple[list[Look], dict[int, str]]:
    """Looks at every frame.

    Returns:
        The frames that can be used, in the order of `records`; and by index, what is wrong with the others.
    """

    def look(record: FrameRecord) -> Look | str:
        return _look(session, record, recipe, config, finder)

    looks: list[Look] = []
    refused: dict[int, str] = {}
    for done, (record, outcome) in enumerate(zip(records, in_order(look, records, threads), strict=True)):
        if isinstance(outcome, str):
            refused[record.index] = outcome
        else:
            looks.append(outcome)
        told((done + 1) / len(records))
    return looks, refused


def _look(
    session: Session, record: FrameRecord, recipe: Recipe, config: SfmConfig, finder: MarkerFinder
) -> Look | str:
    if record.file is None:
        return "it has no picture"
    try:
        radiance = session.load_radiance(record)
        mask = session.load_mask(record) if config.background != "static" else None
    except SessionError as cause:
        return str(cause)
    grey, finite = grey_radiance(radiance, config.max_side_px)
    if float(finite.mean()) < _LEAST_FINITE:
        return f"{100 * (1 - float(finite.mean())):.0f} % of its pixels are not finite"
    height, width = grey.shape
    to_full = np.array([record.width / width, record.height / height])
    places, descriptors = detect_features(feature_picture(grey, recipe.picture), recipe, finite)
    corners, labels = finder.find(grey)
    everything = np.concatenate([places, corners])
    subject = None
    if mask is not None:
        full = (everything * to_full).astype(np.int64)
        subject = (
            mask[np.clip(full[:, 1], 0, mask.shape[0] - 1), np.clip(full[:, 0], 0, mask.shape[1] - 1)] > 127
        )
    return Look(
        record=record,
        size=(width, height),
        features=Features(
            everything,
            descriptors,
            np.concatenate([np.full(len(places), -1, np.int64), labels]),
            colors_at(radiance, everything * to_full),
        ),
        sharpness=sharpness(grey),
        small=small_picture(grey),
        subject=subject,
    )
