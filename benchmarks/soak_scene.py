"""An endless capture at the size of the tagger's thumbnails, with all that goes wrong in one, and the truth.

A head of light and shade before a textured room, seen by a camera that stands, is held or walks, through a
rolling shutter; a lamp that blinks, droops, jitters, misses, is reset in the middle of a pulse and comes back
at another phase; frames that are dropped, stamped a little wrong, unreadable; a camera that stalls or is
restarted; a room light that flickers for a while. Every sensor row integrates the lamp over its own exposure;
light adds linearly; noise and 8-bit sRGB come after. It shares no code with `capture.tagging`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]

ROWS, COLUMNS = 96, 160
_CANVAS = 512
TRUTH_FULL, TRUTH_NONE = 0.98, 0.02
# Kinds of lamp by the standard deviation of a pulse's start: a microcontroller, a USB lamp, a phone.
_TIMERS_S = (5e-5, 5e-5, 1e-3, 4e-3)
# The way the camera moves changes with time: stands, is held, walks, is held.
_MOTIONS = ((0.0, 0.0), (1.0, 0.02), (1.5, 0.3), (1.0, 0.0))
_MOTION_S = 150.0


@dataclass(frozen=True)
class Soak:
    """What is simulated; times in seconds, light in units of white.

    Attributes:
        pulses: that the lamp gives.
        rate_hz: of frames; a little off 30, as two clocks are.
        period_s: of the lamp, likewise.
        on_s: length of a pulse.
        readout_s: of the sensor.
        exposure_s: of a row.
        room: radiance of white under the room light.
        gain: flash over room on the head at the start.
        droop: share of the flash's light lost by the end.
        missed: probability that a pulse does not come.
        reset_every: pulses from reset to reset, on average.
        dropped: probability that a frame is lost.
        burst_every: frames between bursts of lost frames, on average.
        stall_every: frames between stalls of the camera.
        restart_every: frames between restarts after a minute.
        unreadable_every: frames between black ones.
        stamp_s: standard deviation of a frame's stamp.
        flicker: depth of the room light's flicker while it flickers.
        dark_s: how long frames go on after the last pulse.
        seed: of everything.
    """

    pulses: int = 10_000
    rate_hz: float = 30.0 * (1 - 5e-5)
    period_s: float = 1.0 * (1 + 3e-5)
    on_s: float = 0.1
    readout_s: float = 0.0214
    exposure_s: float = 0.005
    room: float = 0.16
    gain: float = 0.9
    droop: float = 0.2
    missed: float = 0.005
    reset_every: float = 400.0
    dropped: float = 0.01
    burst_every: float = 4000.0
    stall_every: float = 40_000.0
    restart_every: float = 90_000.0
    unreadable_every: float = 6000.0
    stamp_s: float = 1e-4
    flicker: float = 0.08
    dark_s: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class LampPulse:
    """One pulse.

    Attributes:
        on_s: true start.
        off_s: true end.
        command_s: when the flash says that it went on.
        light: 1 = as at the start.
        whole: not cut short.
    """

    on_s: float
    off_s: float
    command_s: float
    light: float
    whole: bool


@dataclass(frozen=True, eq=False)
class SoakFrame:
    """One frame that arrives, with the truth.

    Attributes:
        pts_s: its stamp.
        picture: [ROWS, COLUMNS] uint8 sRGB.
        least: lit share of the row that has least.
        most: of the row that has most.
        pulses: number of the pulses that touch it, for accounting.
        events: commands reported since the last frame, seconds.
    """

    pts_s: float
    picture: NDArray[np.uint8]
    least: float
    most: float
    pulses: tuple[int, ...]
    events: tuple[float, ...]

    @property
    def label(self) -> int | None:
        """1 = lit, 0 = unlit, None = in part."""
        return 1 if self.least >= TRUTH_FULL else 0 if self.most <= TRUTH_NONE else None


def soak_frames(soak: Soak) -> Iterator[SoakFrame]:
    """The frames, in order."""
    scene = _Scene(soak)
    rng = np.random.default_rng(soak.seed + 1)
    lamp = _pulses(soak, np.random.default_rng(soak.seed + 2))
    near: deque[tuple[int, LampPulse]] = deque()
    to_come = next(lamp, None)
    number, k, lost, end_s = 0, 0, 0, 0.0
    reported: deque[float] = deque()
    while True:
        k += 1
        start_s = k / soak.rate_hz
        if to_come is not None or near:
            end_s = start_s + soak.dark_s
        elif start_s > end_s:
            return
        while to_come is not None and to_come.on_s < start_s + 1.0:
            near.append((number, to_come))
            reported.append(to_come.command_s)
            number, to_come = number + 1, next(lamp, None)
        while near and near[0][1].off_s < start_s - 1.0:
            near.popleft()
        chance = rng.random(5)
        for every, longest, draw in (
            (soak.burst_every, (3, 20), chance[0]),
            (soak.stall_every, (30, 150), chance[1]),
            (soak.restart_every, (1800, 1900), chance[2]),
        ):
            if draw < 1 / every:
                lost = max(lost, int(rng.integers(*longest)))
        if lost or chance[3] < soak.dropped:
            lost = max(lost - 1, 0)
            continue
        lit, touching = _lit(soak, start_s, near)
        picture = scene.picture(start_s, lit[1:-1])
        if chance[4] < 1 / soak.unreadable_every:
            picture = np.zeros_like(picture)
        events = []
        while reported and reported[0] < start_s:
            events.append(reported.popleft())
        yield SoakFrame(
            pts_s=start_s + soak.stamp_s * float(rng.standard_normal()),
            picture=picture,
            least=float(lit.min()),
            most=float(lit.max()),
            pulses=touching,
            events=tuple(events),
        )


def _pulses(soak: Soak, rng: np.random.Generator) -> Iterator[LampPulse]:
    """The lamp's way, from reset to reset."""
    t, timer_s, given = 0.7, _TIMERS_S[0], 0
    while given < soak.pulses:
        if rng.random() < soak.missed:
            t += soak.period_s
            continue
        on_s = t + 0.004 + abs(timer_s * float(rng.standard_normal()))
        length_s = soak.on_s + timer_s * float(rng.standard_normal())
        light = float((1 - soak.droop * given / soak.pulses) * np.exp(0.005 * rng.standard_normal()))
        reset = rng.random() < 1 / soak.reset_every
        if reset:
            length_s *= float(rng.random())
        given += 1
        # what the host knows of a start is off by a USB frame or so
        yield LampPulse(on_s, on_s + length_s, t + 3e-4 * float(rng.standard_normal()), light, not reset)
        t += soak.period_s
        if reset:
            t += float(rng.uniform(1.5, 8.0))
            timer_s = float(rng.choice(_TIMERS_S))


def _lit(soak: Soak, start_s: float, near: deque[tuple[int, LampPulse]]) -> tuple[Floats, tuple[int, ...]]:
    """[ROWS + 2] lit share at the picture's top edge, its rows' middles, its bottom edge; and the pulses."""
    position = np.concatenate([[0.0], (np.arange(ROWS) + 0.5) / ROWS, [1.0]])
    row_s = start_s + position * soak.readout_s + max(0.0, -soak.readout_s)
    lit, touching = np.zeros(ROWS + 2), []
    for number, pulse in near:
        overlap = np.minimum(row_s + soak.exposure_s, pulse.off_s) - np.maximum(row_s, pulse.on_s)
        if overlap.max() > 0:
            lit += np.clip(overlap / soak.exposure_s, 0, 1)
            touching.append(number)
    return lit, tuple(touching)


class _Scene:
    """Pictures of the head and the room."""

    def __init__(self, soak: Soak) -> None:
        self._soak = soak
        rng = np.random.default_rng(soak.seed + 3)
        self._room, self._skin = _texture(rng, 0.55), _texture(rng, 0.35)
        self._hz = rng.uniform(0.15, 1.0, (4, 4)) * np.array([1, 1, 6, 7])[:, None]
        self._phase = rng.uniform(0, 2 * np.pi, (4, 4))
        self._grain = rng.standard_normal((ROWS + 64, COLUMNS + 64)).astype(np.float32)
        self._rng = rng
        self._turn = self._last_s = 0.0
        self._y, self._x = (a.astype(np.float32) for a in np.mgrid[0:ROWS, 0:COLUMNS])
        x = np.arange(65536) / 65535
        curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
        self._code = np.round(255 * curve).astype(np.uint8)

    def picture(self, t: float, lit: Floats) -> NDArray[np.uint8]:
        """[ROWS, COLUMNS] uint8."""
        soak = self._soak
        at, rest = divmod(t / _MOTION_S, 1)
        now, then = (_MOTIONS[(int(at) + i) % len(_MOTIONS)] for i in (0, 1))
        blend = np.clip((rest - 0.9) / 0.1, 0, 1)
        shake, speed = (float((1 - blend) * a + blend * b) for a, b in zip(now, then, strict=True))
        self._turn += speed * COLUMNS * (t - self._last_s)
        self._last_s = t
        # aim wanders by 1 % of the width, hands tremble by 0.2 %
        x, y, fine_x, fine_y = np.sin(2 * np.pi * self._hz * t + self._phase).sum(axis=1) / 2
        dx, dy = shake * COLUMNS * (0.01 * x + 0.002 * fine_x), shake * COLUMNS * (0.008 * y + 0.002 * fine_y)
        room = _shifted(self._room, self._turn + dx, dy)
        skin = _shifted(self._skin, 0.25 * self._turn + dx, dy)
        u, v = (self._x - COLUMNS / 2 + dx) / 34, (self._y - 50 + dy) / 42
        radius = u * u + v * v
        head = np.clip((1 - radius) * 6, 0, 1)
        facing = np.sqrt(np.clip(1 - 0.8 * radius, 0.08, 1))
        albedo = room + head * (skin - room)
        flash = soak.gain * (head * facing + (1 - head) / 9)
        light = np.ones((ROWS, 1), np.float32)
        if soak.flicker and (t % 1000) > 820:
            row_s = t + (np.arange(ROWS)[:, None] + 0.5) / ROWS * soak.readout_s + soak.exposure_s / 2
            light = (1 + soak.flicker * np.cos(2 * np.pi * 100.05 * row_s)).astype(np.float32)
        linear = albedo * np.float32(soak.room) * (light + flash * lit[:, None].astype(np.float32))
        i, j = self._rng.integers(0, 64, 2)
        linear += self._grain[i : i + ROWS, j : j + COLUMNS] * np.sqrt(linear / 16_000 + 3e-7)
        return self._code[np.clip(linear * 65535, 0, 65535).astype(np.uint16)]


def _texture(rng: np.random.Generator, contrast: float) -> Picture:
    """A wrapped picture with a 1/f spectrum and hard-edged things in it, 0.05 to 0.9."""
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(_CANVAS), np.fft.fftfreq(_CANVAS)))
    spectrum = np.fft.fft2(rng.standard_normal((_CANVAS, _CANVAS))) / np.maximum(f, 1 / _CANVAS)
    picture = np.real(np.fft.ifft2(spectrum))
    picture = np.exp(contrast * picture / picture.std()) * 0.35
    for _ in range(40):
        w, h = rng.integers(10, 90, 2)
        x, y = rng.integers(0, _CANVAS, 2)
        picture[y : y + h, x : x + w] *= np.exp(contrast * 1.5 * rng.standard_normal())
    return cv2.GaussianBlur(np.clip(picture, 0.05, 0.9).astype(np.float32), (0, 0), 0.6)


def _shifted(texture: Picture, x: float, y: float) -> Picture:
    """The texture [ROWS, COLUMNS] from a place, wrapped."""
    matrix = np.array([[1.0, 0.0, x % _CANVAS], [0.0, 1.0, y % _CANVAS]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(texture, matrix, (COLUMNS, ROWS), flags=flags, borderMode=cv2.BORDER_WRAP), np.float32
    )
