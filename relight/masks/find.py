"""Soft masks of all frames of a session from poses, cloud and flash (contract: see `find_masks`).

    cloud ── its subject's piece ── silhouettes ─┐
    lit frames and unlit neighbours ── flash ────┼─ small masks ─┬─ hull, cloud filtered ─┐
    neighbours ── parallax ──────────────────────┘        ▲      └────── rounds ──────────┘
    network (optional) ───────────────────────────────────┘      └─ outline at full size ── PNG, keep

Pictures are read one at a time; between the rounds a frame leaves its small mask and the sum of its evidence
in half precision, about 100 kB, and nothing of its full size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.images import write_png
from capture.session import Session
from relight.masks.colour import display
from relight.masks.config import MaskConfig, MaskResult
from relight.masks.fine import refine
from relight.masks.flash import flash_evidence
from relight.masks.frames import Floats, Frame, FrameSource, shrunk
from relight.masks.hull import Votes, hull_evidence
from relight.masks.outcome import FrameOutcome, check, outline_shift_px, report, warnings
from relight.masks.silhouette import Silhouette, silhouette
from relight.masks.solve import prior, solve
from relight.masks.subject import SubjectCloud, find_subject
from relight.masks.sweep import carried, neighbours, register
from relight.masks.tune import Agreement, network_mask, tune
from relight.masks.u2net import load_u2net, network_input
from relight.stages import Progress, no_progress

_HULL_VIEWS = 12
_FINEST_PX = 1280  # longest side at which outlines are sought; masks of larger frames are enlarged
_MOST_WORKERS = 4
_MOVED_PX = 0.8  # of the small picture: by less the outlines of masks and clouds differ anyway
_NETWORK_LIMIT = 3.0  # log-odds

_Result = TypeVar("_Result")


@dataclass(eq=False)
class _State:
    """What is kept between the rounds."""

    source: FrameSource
    subject: SubjectCloud
    config: MaskConfig
    points: torch.Tensor  # [Q, 3] of the subject, fewer after each round
    odds: dict[int, NDArray[np.float16]] = field(default_factory=dict)
    masks: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    flash: dict[int, NDArray[np.float16]] = field(default_factory=dict)
    separations: list[float] = field(default_factory=list)
    shifts: dict[int, NDArray[np.float64]] = field(default_factory=dict)  # [2] of the head, small pixels

    @property
    def frames(self) -> list[Frame]:
        return list(self.source.frames.values())

    def seen(self, frame: Frame, camera: Camera) -> Silhouette:
        """The cloud in a frame, at a camera's size, displaced where the head is."""
        if frame.index in self.shifts:
            moved = camera.K.copy()
            moved[:2, 2] += self.shifts[frame.index] * camera.width / frame.small.width
            camera = replace(camera, K=moved)
        return silhouette(self.points, camera, self.subject.spacing, self.subject.noise)


def find_masks(
    session: Session,
    cameras: Mapping[int, Camera],
    points: NDArray[np.floating],
    normals: NDArray[np.floating] | None,
    folder: Path,
    config: MaskConfig | None = None,
    progress: Progress = no_progress,
) -> MaskResult:
    """Finds the subject (head, hair, neck, shoulders as far as in view) in every frame.

    Frames that are kept for validation are neither read nor given a mask.

    Args:
        session: Is read.
        cameras: By index of the frame.
        points: [P, 3] dense cloud, world; may have strays, holes and pieces of the room.
        normals: Not needed; the cloud's outline is told from its points.
        folder: Masks go there as NNNNNN.png, 8-bit grey, 255 = subject; made if need be.
        config: See there; the defaults where it is None.
        progress: Told ("masks", fraction).

    Raises:
        GeometryError: No frame, hardly a cloud, a network that cannot be read, or masks that say nothing.
    """
    started_s = time.perf_counter()
    config = config or MaskConfig()
    source = FrameSource(session, cameras, config.working_px)
    subject = find_subject(points, [frame.camera for frame in source.frames.values()])
    state = _State(source, subject, config, torch.from_numpy(subject.points))
    total = (2 * config.rounds + 3) * len(source.frames)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        progress("masks", min(1.0, done / total))

    agreement = _add_network(state) if config.u2net else None
    _add_flash(state)
    for _, (index, odds) in _each(state.frames, lambda frame: (frame.index, _evidence(state, frame))):
        state.odds[index] = odds
        step()
    share = None
    for number in range(config.rounds):
        share = _round(state, number, points, step)
        inside = share <= config.outside_share
        kept = subject.points[inside[subject.chosen]]
        if len(kept) > 0.2 * len(subject.points):  # else the masks are at fault, not the cloud
            state.points = torch.from_numpy(np.ascontiguousarray(kept))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    votes = Votes(points)
    outcomes = []
    for frame, (mask, outcome) in _each(state.frames, lambda frame: _finish(state, frame, folder)):
        votes.add(mask, frame.camera)
        outcomes.append(outcome)
        step()
    check(outcomes)
    keep = votes.share() <= config.outside_share
    progress("masks", 1.0)
    seconds = time.perf_counter() - started_s
    return MaskResult(
        keep=keep,
        report=report(outcomes, state.separations, keep, subject, config, seconds)
        | ({} if agreement is None else {"network_tuning": asdict(agreement)}),
        warnings=warnings(outcomes, state.separations, keep, config, [frame.flash for frame in state.frames]),
    )


def _each(frames: Sequence[Frame], work: Callable[[Frame], _Result]) -> Iterator[tuple[Frame, _Result]]:
    """Work on each frame, in order, on as many threads as torch may use (most of it is outside of Python)."""
    workers = min(_MOST_WORKERS, torch.get_num_threads())
    if workers == 1:
        for frame in frames:
            yield frame, work(frame)
        return
    with ThreadPoolExecutor(workers) as pool:
        # In batches, so that results wait in memory for a few frames only.
        for start in range(0, len(frames), 2 * workers):
            batch = frames[start : start + 2 * workers]
            yield from zip(batch, pool.map(work, batch), strict=True)


def _add_network(state: _State) -> Agreement | None:
    """The network's masks as log-odds; its weights tuned for agreement first, if asked for."""
    config = state.config
    network = load_u2net(Path(config.u2net))

    def picture(frame: Frame) -> torch.Tensor:
        return network_input(state.source.radiance(frame))

    agreement = None
    if config.tune_steps:
        agreement = tune(
            network,
            picture,
            state.frames,
            state.subject,
            config.tune_steps,
            config.tune_rate,
            config.outside_share,
        )
    for frame in state.frames:
        mask = np.clip(network_mask(network, picture(frame), frame), 1e-6, 1.0 - 1e-6)
        odds = np.log(mask / (1.0 - mask))
        state.odds[frame.index] = np.clip(odds, -_NETWORK_LIMIT, _NETWORK_LIMIT).astype(np.float16)
    return agreement


def _add_flash(state: _State) -> None:
    """Flash evidence of the lit frames."""
    if not state.config.flash:
        return
    lit = [frame for frame in state.frames if frame.flash == 1]

    def work(frame: Frame) -> tuple[Floats, float] | None:
        around = neighbours(frame, state.frames, 0, state.subject.distance)
        seen = state.seen(frame, frame.small)
        if not around or not seen.inside.any():
            return None
        unlit = register(frame, around, state.source, seen.depth, seen.inside)
        found = flash_evidence(state.source.small(frame), unlit, seen.distance_px)
        return found.odds, found.separation

    for frame, found in _each(lit, work):
        if found is not None:
            state.flash[frame.index] = found[0].astype(np.float16)
            state.separations.append(found[1])


def _evidence(state: _State, frame: Frame) -> NDArray[np.float16]:
    """The sum of what flash, parallax and network say of a frame [h, w], without the cloud."""
    seen = state.seen(frame, frame.small)
    odds = np.zeros(seen.depth.shape, np.float32)
    if frame.index in state.odds:
        odds += state.odds[frame.index]  # the network's
    if not seen.inside.any():
        return odds.astype(np.float16)
    distance = state.subject.distance
    if frame.index in state.flash:
        odds += state.flash[frame.index]
    else:
        lit = [each for each in neighbours(frame, state.frames, 1, distance)[:2] if each.index in state.flash]
        if lit:
            maps = [state.flash[each.index].astype(np.float32) for each in lit]
            odds += carried(maps, [each.small for each in lit], frame.small, seen.depth)[0]
    if state.config.parallax and frame.flash is not None:
        around = neighbours(frame, state.frames, frame.flash, distance)
        if around:
            odds += register(frame, around, state.source, seen.depth, seen.inside).parallax
    return odds.astype(np.float16)


def _round(
    state: _State, number: int, points: NDArray[np.floating], step: Callable[[], None]
) -> NDArray[np.float32]:
    """Small masks of all frames, by the hull of the former ones where there are any.

    Returns:
        [P] share of the frames in which each point of the cloud is off the mask.
    """
    former = dict(state.masks)
    votes = Votes(points)
    for frame, (mask, shift) in _each(state.frames, lambda frame: _small_mask(state, frame, former)):
        if np.hypot(*shift) > _MOVED_PX:
            state.shifts[frame.index] = shift
        state.masks[frame.index] = np.round(255.0 * mask).astype(np.uint8)
        votes.add(mask, frame.small)
        step()
    return votes.share()


def _small_mask(
    state: _State, frame: Frame, former: Mapping[int, NDArray[np.uint8]]
) -> tuple[Floats, NDArray[np.float64]]:
    """The small mask of a frame, and by how much [2] the head lies beside its cloud there, pixels."""
    seen = state.seen(frame, frame.small)
    rotation_deg = state.source.rotation_deg
    odds = prior(seen, rotation_deg) + state.odds[frame.index]
    if former and state.config.hull:
        claimed = (seen.distance_px < 0) & ((former[frame.index] > 13) | (odds > -3.0))
        others = [other for other in state.frames if other.index != frame.index]
        others = others[:: max(1, len(others) // _HULL_VIEWS)]
        masks = [former[other.index].astype(np.float32) / np.float32(255.0) for other in others]
        odds[claimed] += hull_evidence(
            frame.small, seen.depth, claimed, masks, [other.small for other in others]
        )
    mask = solve(display(state.source.small(frame)), odds, seen)
    shift = outline_shift_px(mask, seen)
    return mask, state.shifts.get(frame.index, np.zeros(2)) + shift


def _finish(state: _State, frame: Frame, folder: Path) -> tuple[Floats, FrameOutcome]:
    """A frame's mask at full size, written; and what it is like."""
    longest = max(frame.camera.width, frame.camera.height)
    camera = frame.camera.scaled(min(1.0, _FINEST_PX / longest))
    seen = state.seen(frame, camera)
    picture = display(shrunk(state.source.radiance(frame), camera))
    small = state.masks[frame.index].astype(np.float32) / np.float32(255.0)
    mask = refine(picture, small, seen)
    shift = outline_shift_px(mask, seen)
    before = state.shifts.get(frame.index, np.zeros(2))
    outcome = FrameOutcome(
        index=frame.index,
        coverage=float(mask.mean()),
        cloud_coverage=float(seen.inside.mean()),
        agreement=_iou(mask > 0.5, seen.inside),
        shift_px=float(np.hypot(*(shift / max(mask.shape) + before / max(small.shape)))) * longest,
        longest_px=longest,
    )
    if mask.shape != (frame.camera.height, frame.camera.width):
        size = (frame.camera.width, frame.camera.height)
        mask = np.clip(cv2.resize(mask, size, interpolation=cv2.INTER_CUBIC), 0.0, 1.0).astype(np.float32)
    stored = np.round(255.0 * state.source.in_frame_pixels(mask, frame)).astype(np.uint8)
    write_png(folder / f"{frame.index:06d}.png", stored)
    return mask, outcome


def _iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    union = np.count_nonzero(first | second)
    return float(np.count_nonzero(first & second) / union) if union else 0.0
