"""Which frames are worth comparing: neighbours along the capture path, and places that were passed again.

Every comparison costs; all pairs of a hundred frames are five thousand. Neighbours at growing distances tie
the path together, and a cheap descriptor of the whole frame, VLAD (Jégou et al. 2010) of its features,
proposes frames that are far apart in time and see the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

EXHAUSTIVE_UP_TO = 24
"""As many frames are compared all with all: 276 pairs."""

_OFFSETS = (1, 2, 4, 8, 16, 24)  # the long ones keep the path from bending
_WIDE_OFFSETS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32)
_ALIKE = 2  # frames that look most alike, beyond the neighbours
_ALIKE_WIDE = 8
_NEAR = 4
_WORDS = 48
_SAMPLE = 6000
_ROUNDS = 8


def choose_pairs(
    descriptors: Sequence[NDArray[np.uint8]],
    lit: Sequence[bool],
    *,
    wide: bool = False,
    seed: int = 0,
) -> list[tuple[int, int]]:
    """Positions (i, j), i < j, of frames to compare, in order.

    Args:
        descriptors: [N, 128] of each frame, in the order of capture.
        lit: Whether the flash lit a frame.
        wide: More of them, where the usual ones did not do.
        seed: Of the vocabulary.
    """
    count = len(descriptors)
    if count <= (2 * EXHAUSTIVE_UP_TO if wide else EXHAUSTIVE_UP_TO):
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    offsets = _WIDE_OFFSETS if wide else _OFFSETS
    pairs = {(i, i + step) for step in offsets for i in range(count - step)}
    # Lit frames are far apart in time but alike in light: each with the next three of its kind.
    alight = [i for i in range(count) if lit[i]]
    if len(alight) < count:
        pairs |= {(a, b) for step in (1, 2, 3) for a, b in zip(alight, alight[step:], strict=False)}
    likeness = global_likeness(descriptors, seed)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    # A place that was passed again looks as much alike as frames a few steps apart do.
    enough = -np.inf if wide else float(np.median(likeness[apart == _OFFSETS[-2]]))
    near = _NEAR if wide else _OFFSETS[-1]
    likeness = np.where((apart <= near) | (likeness < enough), -np.inf, likeness)
    most = _ALIKE_WIDE if wide else _ALIKE
    for i in range(count):
        for j in np.argsort(-likeness[i], kind="stable")[:most]:
            if np.isfinite(likeness[i, j]):
                pairs.add((min(i, int(j)), max(i, int(j))))
    return sorted(pairs)


def global_likeness(descriptors: Sequence[NDArray[np.uint8]], seed: int) -> NDArray[np.float32]:
    """[F, F] cosine of the frames' VLADs; -1 for frames without features."""
    signatures = [_thinned(d, 600) for d in descriptors]
    everything = np.concatenate([*signatures, np.zeros((0, 128), np.uint8)]).astype(np.float32)
    if len(everything) < 2 * _WORDS:
        return np.full((len(descriptors), len(descriptors)), -1.0, np.float32)
    words = _vocabulary(everything, seed)
    vlads = np.stack([_vlad(d.astype(np.float32), words) for d in signatures])
    likeness = vlads @ vlads.T
    empty = ~vlads.any(axis=1)
    likeness[empty] = -1.0
    likeness[:, empty] = -1.0
    return np.asarray(likeness, np.float32)


def _thinned(descriptors: NDArray[np.uint8], most: int) -> NDArray[np.uint8]:
    return descriptors[:most]  # the strongest come first


def _vocabulary(everything: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    random = np.random.default_rng(seed)
    sample = everything[random.choice(len(everything), min(_SAMPLE, len(everything)), replace=False)]
    words = sample[:_WORDS].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest_word(sample, words)
        for word in range(len(words)):
            members = sample[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def _nearest_word(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.asarray((descriptors @ words.T - 0.5 * (words * words).sum(axis=1)).argmax(axis=1))


def _vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """[W * 128] residuals to the words, power- and intra-normalised."""
    vlad = np.zeros_like(words)
    if not len(descriptors):
        return vlad.ravel()
    nearest = _nearest_word(descriptors, words)
    np.add.at(vlad, nearest, descriptors - words[nearest])
    vlad /= np.maximum(np.linalg.norm(vlad, axis=1, keepdims=True), 1e-9)
    flat = np.sign(vlad) * np.sqrt(np.abs(vlad))
    return np.asarray(flat.ravel() / max(float(np.linalg.norm(flat)), 1e-9), np.float32)
