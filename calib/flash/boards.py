"""The light of pulses on boards, as arrays, and the errors that are in it.

Three kinds of error make the relative difference between measured and predicted light of a white square:

    each square by itself   noise of its pixels, and `texture`: what is left (paper, print)
    a whole board together  `pulse`: pulses are not equally bright
    a board's pose          its six numbers are known only as well as its corners were found

So the covariance of one board's squares is  noise^2 + texture^2 + pulse^2 1 1^T + Q Q^T,  with Q the change
of the light with the pose times the square root of the pose's covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.flash.model import Light, log_light, log_light_with_slopes

Floats = NDArray[np.float64]

# A board that moves by less stood still (radians; share of its distance): some ten times the error of a pose.
_STILL_TURN, _STILL_MOVE = np.radians(1.0), 0.004


@dataclass(frozen=True, eq=False)
class LitBoard:
    """The light of one pulse, or the mean of several, on the white squares of one board.

    Attributes:
        name: of the picture with the flash.
        time_s: of the pulse.
        points_cam: [n, 3] middle of what was measured of each square, camera axes, metres.
        reach_cam: [n, 4, 3] four points whose mean and spread are those of all points measured of a square.
        normal_cam: [3] unit, towards the camera.
        radiance: [n, 3] with the flash minus without, after the flat field.
        noise: [n] standard deviation of the sum over the channels, relative.
        pose_covariance: [6, 6] of the board's rotation (about the camera's axes, at the camera) of its
            points about its own origin, rad, and translation, m.
        origin_cam: [3] of the board, camera axes, metres.
        squares: [n] number of each square, row by row of the board.
    """

    name: str
    time_s: float
    points_cam: Floats
    reach_cam: Floats
    normal_cam: Floats
    radiance: Floats
    noise: Floats
    pose_covariance: Floats
    origin_cam: Floats
    squares: NDArray[np.int64]

    def part(self, chosen: NDArray[np.bool_]) -> LitBoard:
        """Some of its squares."""
        return replace(
            self,
            points_cam=self.points_cam[chosen],
            reach_cam=self.reach_cam[chosen],
            radiance=self.radiance[chosen],
            noise=self.noise[chosen],
            squares=self.squares[chosen],
        )


@dataclass(frozen=True, eq=False)
class Spread:
    """The errors that are no pixel noise, relative standard deviations: of squares, and of pulses."""

    texture: float
    pulse: float


@dataclass(frozen=True, eq=False)
class Stack:
    """V boards in arrays of equal length: rows that a board does not have say nothing.

    Attributes:
        boards: the boards.
        there: [V, N] which rows are real.
        points_cam: [V, N, 3] metres.
        normals_cam: [V, N, 3].
        time: [V, N] in the capture, -1/2..1/2.
        light: [V, N] mean of the channels in the middle of each square.
        noise: [V, N] relative.
        arms: [V, N, 3] from the board's origin to the point.
        pose_roots: [V, 6, 6] square roots of the pose covariances.
    """

    boards: Sequence[LitBoard]
    there: NDArray[np.bool_]
    points_cam: Floats
    normals_cam: Floats
    time: Floats
    light: Floats
    noise: Floats
    arms: Floats
    pose_roots: Floats

    def part(self, chosen: NDArray[np.bool_]) -> Stack:
        """Some of its boards."""
        return Stack(
            [board for board, kept in zip(self.boards, chosen, strict=True) if kept],
            *(
                getattr(self, name)[chosen]
                for name in (
                    "there",
                    "points_cam",
                    "normals_cam",
                    "time",
                    "light",
                    "noise",
                    "arms",
                    "pose_roots",
                )
            ),
        )


def merged_stills(boards: Sequence[LitBoard]) -> list[LitBoard]:
    """Pulses that follow each other on a board that stood still become one: the mean of their light.

    Their poses have the same error, and their squares the same paper: they are no new evidence of these.
    """
    groups: list[list[LitBoard]] = []
    for board in boards:
        if groups and _still(groups[-1][0], board):
            groups[-1].append(board)
        else:
            groups.append([board])
    return [_mean_of(group) if len(group) > 1 else group[0] for group in groups]


def _still(one: LitBoard, other: LitBoard) -> bool:
    turned = float(np.arccos(np.clip(one.normal_cam @ other.normal_cam, -1, 1)))
    moved = float(np.linalg.norm(one.origin_cam - other.origin_cam) / np.linalg.norm(one.origin_cam))
    common = np.intersect1d(one.squares, other.squares)
    return turned < _STILL_TURN and moved < _STILL_MOVE and len(common) > 0.8 * len(one.squares)


def _mean_of(group: Sequence[LitBoard]) -> LitBoard:
    common = group[0].squares
    for board in group[1:]:
        common = np.intersect1d(common, board.squares)
    parts = [board.part(np.isin(board.squares, common)) for board in group]
    squared = np.mean([part.noise**2 for part in parts], axis=0)
    return replace(
        parts[0],
        name=f"{group[0].name} and {len(group) - 1} more",
        time_s=float(np.mean([part.time_s for part in parts])),
        points_cam=np.mean([part.points_cam for part in parts], axis=0),
        reach_cam=np.mean([part.reach_cam for part in parts], axis=0),
        radiance=np.mean([part.radiance for part in parts], axis=0),
        noise=np.sqrt(squared / len(parts)),
    )


def stacked(boards: Sequence[LitBoard], about: Light) -> Stack:
    """Boards as arrays; their times become the part of the capture that had passed, from -1/2 to 1/2.

    Args:
        boards: the boards.
        about: roughly the light: within a square it bends, and so its mean is not the light in the middle.
    """
    longest = max(len(board.points_cam) for board in boards)
    count = len(boards)
    seconds = np.array([board.time_s for board in boards])
    duration = max(float(np.ptp(seconds)), 1e-9)
    there = np.zeros((count, longest), bool)
    points = np.tile([0.0, 0.0, 1.0], (count, longest, 1))
    normals = np.tile([0.0, 0.0, -1.0], (count, longest, 1))
    light, noise = np.ones((count, longest)), np.ones((count, longest))
    arms = np.zeros((count, longest, 3))
    for number, board in enumerate(boards):
        n = len(board.points_cam)
        there[number, :n] = True
        points[number, :n] = board.points_cam
        normals[number] = board.normal_cam
        light[number, :n] = board.radiance.mean(1) / _mean_over_middle(board, about)
        noise[number, :n] = board.noise
        arms[number, :n] = board.points_cam - board.origin_cam
    share = (seconds - seconds.min()) / duration - 0.5
    roots = np.array([_root(board.pose_covariance) for board in boards])
    times = np.repeat(share[:, None], longest, axis=1)
    return Stack(boards, there, points, normals, times, light, noise, arms, roots)


def _mean_over_middle(board: LitBoard, about: Light) -> Floats:
    """[n] mean of the light over each square by that in its middle."""
    time = np.zeros(())
    around = log_light(about, board.reach_cam, board.normal_cam, time)
    middle = log_light(about, board.points_cam, board.normal_cam, time)
    ratio: Floats = np.exp(around - middle[:, None]).mean(1)
    return ratio


def relative_residuals(stack: Stack, light: Light) -> Floats:
    """[V, N] measured over predicted light minus one; 0 in rows that are not there."""
    value = log_light(light, stack.points_cam, stack.normals_cam, stack.time)
    return np.where(stack.there, stack.light * np.exp(-value) - 1.0, 0.0)


def error_covariance(stack: Stack, light: Light, spread: Spread) -> Floats:
    """[V, N, N] of the relative residuals of each board; the unit matrix in rows that are not there."""
    return covariance_of(stack.there, square_noise(stack, light), pose_change(stack, light), spread)


def light_slopes(stack: Stack, light: Light, free: NDArray[np.int64]) -> Floats:
    """[V, N, p] relative change of the light with the free numbers; 0 in rows that are not there."""
    _, by_light, _, _ = log_light_with_slopes(light, stack.points_cam, stack.normals_cam, stack.time)
    return np.where(stack.there[..., None], by_light[..., free], 0.0)


def square_noise(stack: Stack, light: Light) -> Floats:
    """[V, N] noise relative to the predicted light (that of the measured light would favour dark errors)."""
    return stack.noise * (1.0 + np.clip(relative_residuals(stack, light), -0.5, 1.0))


def pose_change(stack: Stack, light: Light) -> Floats:
    """[V, N, 6] relative change of the light by one standard deviation along each axis of the pose."""
    _, _, by_point, by_normal = log_light_with_slopes(light, stack.points_cam, stack.normals_cam, stack.time)
    by_turn = np.cross(stack.arms, by_point) + np.cross(stack.normals_cam, by_normal)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    change: Floats = by_pose @ stack.pose_roots
    return np.where(stack.there[..., None], change, 0.0)


def covariance_of(there: NDArray[np.bool_], noise: Floats, change: Floats, spread: Spread) -> Floats:
    """As `error_covariance`, of what `square_noise` and `pose_change` give."""
    variance = np.where(there, noise**2 + spread.texture**2, 1.0)
    ones = there.astype(np.float64)
    covariance: Floats = change @ np.swapaxes(change, 1, 2)
    covariance += spread.pulse**2 * ones[:, :, None] * ones[:, None, :]
    rows = np.arange(there.shape[1])
    covariance[:, rows, rows] += variance
    return covariance


def _root(covariance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    root: Floats = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
