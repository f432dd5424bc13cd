"""The network's weights tuned until its masks agree between the views (Sevastopolsky 2020, section 3.3).

The paper adds "multi-view consistency of the silhouettes via visual hull estimation using point cloud as a
geometric proxy, and using the weights of the segmentation network as a parameterization". So, in turns: the
masks of all frames say which points of the cloud are the subject (those in nearly every mask); the
silhouettes of these points are what the masks should be; and the weights take steps towards it by -log Dice,
the paper's measure of masks (L_mask). Normalisation keeps the statistics of its training: a batch is a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from relight.errors import GeometryError
from relight.masks.frames import Floats, Frame
from relight.masks.hull import Votes
from relight.masks.silhouette import silhouette
from relight.masks.subject import SubjectCloud
from relight.masks.u2net import U2Net

_FEWEST_INSIDE = 0.05  # share of the cloud in the masks below which there is nothing to agree on


@dataclass(frozen=True)
class Agreement:
    """Mean 1 - Dice of masks and hull silhouettes before and after tuning, and the steps taken."""

    before: float
    after: float
    steps: int


def network_mask(network: U2Net, picture: torch.Tensor, frame: Frame) -> Floats:
    """The network's mask [h, w] 0..1 of a frame's small picture."""
    with torch.no_grad():
        odds = network(picture)[0, 0].numpy()
    size = (frame.small.width, frame.small.height)
    resized = cv2.resize(odds, size, interpolation=cv2.INTER_LINEAR)
    return (1.0 / (1.0 + np.exp(-np.clip(resized, -30.0, 30.0)))).astype(np.float32)


def tune(
    network: U2Net,
    pictures: Callable[[Frame], torch.Tensor],
    frames: Sequence[Frame],
    subject: SubjectCloud,
    steps: int,
    rate: float,
    outside_share: float,
) -> Agreement:
    """Changes the network's weights in place.

    Args:
        network: In evaluation mode, where it stays.
        pictures: The network's input [1, 3, S, S] of a frame.
        frames: At least one.
        subject: The cloud that stands for the surface.
        steps: Of Adam, one frame each, evenly over the frames.
        rate: Adam's.
        outside_share: As in `MaskConfig`.

    Raises:
        GeometryError: The network finds the cloud in no frame, so there is nothing to agree on.
    """
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    before = None
    taken = 0
    while taken < steps:
        hull = _hull_points(network, pictures, frames, subject, outside_share)
        if before is None:
            before = _disagreement(network, pictures, frames, hull, subject)
        count = min(len(frames), steps - taken)
        order = np.linspace(0, len(frames) - 1, count).round().astype(int)
        for position in order:
            picture = pictures(frames[position])
            target = torch.from_numpy(_target(hull, frames[position], subject, picture.shape[-1]))
            loss = -torch.log(_dice(torch.sigmoid(network(picture)[0, 0]), target))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        taken += count
    hull = _hull_points(network, pictures, frames, subject, outside_share)
    after = _disagreement(network, pictures, frames, hull, subject)
    return Agreement(after if before is None else before, after, taken)


def _hull_points(
    network: U2Net,
    pictures: Callable[[Frame], torch.Tensor],
    frames: Sequence[Frame],
    subject: SubjectCloud,
    outside_share: float,
) -> torch.Tensor:
    """The points [Q, 3] that the masks of nearly all frames hold."""
    votes = Votes(subject.points)
    for frame in frames:
        votes.add(network_mask(network, pictures(frame), frame), frame.small)
    inside: NDArray[np.bool_] = votes.share() <= outside_share
    if inside.mean() < _FEWEST_INSIDE:
        raise GeometryError(
            f"The network's masks hold {100 * inside.mean():.0f} % of the cloud, but tuning it for agreement "
            f"between the views needs {100 * _FEWEST_INSIDE:.0f} %; set tune_steps to 0, or give other "
            "weights."
        )
    return torch.from_numpy(np.ascontiguousarray(subject.points[inside]))


def _target(hull: torch.Tensor, frame: Frame, subject: SubjectCloud, side_px: int) -> Floats:
    """The hull's silhouette [S, S] in the network's picture."""
    seen = silhouette(hull, frame.small, subject.spacing, subject.noise)
    inside = np.asarray(seen.inside, np.float32)
    return np.asarray(cv2.resize(inside, (side_px, side_px), interpolation=cv2.INTER_LINEAR), np.float32)


def _disagreement(
    network: U2Net,
    pictures: Callable[[Frame], torch.Tensor],
    frames: Sequence[Frame],
    hull: torch.Tensor,
    subject: SubjectCloud,
) -> float:
    total = 0.0
    for frame in frames:
        picture = pictures(frame)
        with torch.no_grad():
            mask = torch.sigmoid(network(picture)[0, 0])
        target = torch.from_numpy(_target(hull, frame, subject, picture.shape[-1]))
        total += 1.0 - float(_dice(mask, target))
    return total / len(frames)


def _dice(mask: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """F1 score of soft masks; 1 when both are empty."""
    return (2.0 * (mask * target).sum() + 1.0) / (mask.sum() + target.sum() + 1.0)
