"""A light video simulator for the tagger: a hand-held walk around a head lit by a blinking flash, rolling
shutter.

It is no renderer (the simulated rig is): the head and the room are flat textures that move as a camera
would make them move. What matters for tagging is exact: every sensor row integrates the lamp's waveform
over its own exposure, light adds linearly, and noise, clipping and 8-bit encoding come after. The scene
shares no code with `capture.tagging`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
CANVAS_PX = 1024  # side of the wrapped textures
TRUTH_FULL, TRUTH_NONE = 0.98, 0.02  # the labels' definition: shutter rows all above, or all below


@dataclass(frozen=True)
class Video:
    """What is simulated; times in seconds, light in units of the sensor's white level."""

    width: int = 320
    height: int = 180
    rate_hz: float = 30.0
    duration_s: float = 10.0
    readout_s: float = (
        0.02  # first row's start to the start of the row after the last; negative: bottom row first
    )
    exposure_s: float = 0.005
    # --- lamp
    period_s: float = 1.0
    on_s: float = 0.1
    first_s: float = 0.37
    # "hardware": fixed rate, 0.1 ms jitter; "phone": fixed delay with jank, as Android's Timer
    timer: str = "hardware"
    rise_s: float = 0.0
    fall_s: float = 0.0
    droop: float = 0.0  # share of the light lost by the end of a pulse
    missed: tuple[int, ...] = ()  # pulses that did not fire
    flash: bool = True
    always_on: bool = False
    # --- light
    room: float = 0.12  # radiance of a white surface under room light
    gain: float = 0.7  # flash over room on the brightest part of the head
    background_gain: float = 0.10  # the same on the background
    flicker_hz: float = 0.0
    flicker_depth: float = 0.0
    # --- camera
    motion: str = "walk"  # "still", "hand", "walk"
    noise: float = 1.0  # times a phone's at moderate gain
    drift_per_s: float = 0.0  # slow change of exposure, log units per second
    step_at_s: float | None = None
    step: tuple[float, float, float] = (1.0, 1.0, 1.0)  # gain of the channels after step_at_s
    dropped: float = 0.0  # probability that a frame is lost
    pts_jitter_s: float = 0.0
    color: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Truth:
    """The simulated sequence's truth: per frame and row the lit fraction, and the pulses."""

    pts_s: Floats  # [K]
    lit: Floats  # [K, H] lit fraction of each row
    on_s: Floats  # [P] pulse starts
    off_s: Floats  # [P] pulse ends
    labels: tuple[int | None, ...] = field(default=())  # 1, 0, None = partial


def _pulses(video: Video, rng: np.random.Generator) -> tuple[Floats, Floats]:
    if not video.flash:
        return np.zeros(0), np.zeros(0)
    if video.always_on:
        return np.array([-1.0]), np.array([video.duration_s + 1.0])
    on, off = [], []
    t = video.first_s
    while t < video.duration_s + 0.1:
        late, longer = (
            (rng.normal(0, 1e-4), rng.normal(0, 1e-4))
            if video.timer == "hardware"
            else (rng.exponential(0.008), rng.normal(0, 0.008))
        )
        on.append(t + late)
        off.append(t + late + video.on_s + longer)
        # fixed delay: the next start counts from this one, so lateness accumulates
        t = (
            t + video.period_s
            if video.timer == "hardware"
            else t + late + video.period_s + rng.exponential(0.003)
        )
    keep = [i for i in range(len(on)) if i not in video.missed]
    return np.array(on)[keep], np.array(off)[keep]


def _lamp_integral(t: Floats, on: float, off: float, video: Video) -> Floats:
    """Integral of one pulse's waveform from -inf to t: linear rise and fall around a drooping plateau."""

    def ramp(x: Floats, width: float) -> Floats:
        if width <= 0:
            return np.maximum(x, 0.0)
        y = np.clip(x, 0, width)
        return 0.5 * y * y / width + np.maximum(x - width, 0.0)

    plateau = ramp(t - on, video.rise_s) - ramp(t - off, video.fall_s)
    if video.droop:
        x = np.clip(t - on, 0, off - on)
        plateau = plateau - video.droop * 0.5 * x * x / (off - on)
    return plateau


def make_truth(video: Video) -> Truth:
    """Times, pulses and per-row lit fractions of a video."""
    rng = np.random.default_rng(video.seed + 1000)
    start = np.arange(round(video.duration_s * video.rate_hz)) / video.rate_hz
    start = start + video.pts_jitter_s * rng.standard_normal(len(start))
    start = start[rng.random(len(start)) >= video.dropped]
    on, off = _pulses(video, rng)
    row_start = start[:, None] + (np.arange(video.height) + 0.5) / video.height * video.readout_s
    if video.readout_s < 0:
        row_start = row_start - video.readout_s
    lit = np.zeros_like(row_start)
    for a, b in zip(on, off, strict=True):
        end = _lamp_integral(row_start + video.exposure_s, a, b, video)
        lit += (end - _lamp_integral(row_start, a, b, video)) / video.exposure_s
    # a drooping lamp is fully on at its lowest level
    full = TRUTH_FULL * (1 - video.droop)
    labels = tuple(1 if row.min() >= full else 0 if row.max() <= TRUTH_NONE else None for row in lit)
    return Truth(pts_s=start, lit=lit, on_s=on, off_s=off, labels=labels)


@lru_cache(maxsize=4)
def _texture(seed: int, contrast: float) -> NDArray[np.float32]:
    """A wrapped picture with a 1/f spectrum and hard-edged things in it, mean about 0.35, range 0.03 to
    0.9."""
    rng = np.random.default_rng(seed)
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(CANVAS_PX), np.fft.fftfreq(CANVAS_PX)))
    spectrum = np.fft.fft2(rng.standard_normal((CANVAS_PX, CANVAS_PX))) / np.maximum(f, 1 / CANVAS_PX)
    picture = np.real(np.fft.ifft2(spectrum))
    picture = np.exp(contrast * picture / picture.std()) * 0.35
    for _ in range(40):
        w, h = rng.integers(30, 220, 2)
        x, y = rng.integers(0, CANVAS_PX, 2)
        picture[y : y + h, x : x + w] *= np.exp(contrast * 1.5 * rng.standard_normal())
    return np.clip(picture, 0.03, 0.9).astype(np.float32)


@lru_cache(maxsize=2)
def _noise_bank(height: int, width: int) -> NDArray[np.float32]:
    return np.random.default_rng(99).standard_normal((12, height + 64, width + 64)).astype(np.float32)


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    x = np.arange(65536) / 65535
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


class _Path:
    """A camera's way around the head as picture motion: [K] pans, zoom and roll, smooth and shaky."""

    def __init__(self, video: Video, t: Floats):
        rng = np.random.default_rng(video.seed + 2000)
        shake = {"still": 0.0, "hand": 1.0, "walk": 1.6}[video.motion]
        speed = {"still": 0.0, "hand": 0.03, "walk": 0.45}[video.motion]  # widths a second of the background

        def wander(amplitude: float, slowest_hz: float, fastest_hz: float) -> Floats:
            hz = rng.uniform(slowest_hz, fastest_hz, 5)
            phase, size = rng.uniform(0, 2 * np.pi, 5), rng.uniform(0.5, 1.0, 5) / 2
            return amplitude * (np.sin(2 * np.pi * hz * t[:, None] + phase) * size).sum(axis=1)

        w = video.width
        # tremor: 0.3 % of the width at 2-8 Hz (0.2 degrees); aim: 2 % at 0.2-1 Hz
        self.head_x = shake * w * (wander(0.02, 0.2, 1.0) + wander(0.003, 2, 8))
        self.head_y = shake * w * (wander(0.015, 0.2, 1.0) + wander(0.003, 2, 8))
        self.zoom = 1 + shake * wander(0.03, 0.1, 0.6)
        self.roll = shake * np.radians(wander(1.5, 0.2, 0.8) + wander(0.15, 2, 6))
        sway = 1 + 0.4 * np.sin(2 * np.pi * 0.3 * t + rng.uniform(0, 6))
        self.turn = speed * w * (t + 0.4 * np.cumsum(sway - 1) * np.gradient(t)) if len(t) > 1 else t * 0


def _seen(
    picture: NDArray[np.float32],
    size: tuple[int, int],
    scale: float,
    turn: tuple[float, float],
    centre: tuple[float, float],
    x0: float,
    shear: float,
) -> NDArray[np.float32]:
    """A texture [h, w] as a camera that rolls by (cos, sin) about a centre sees it, its rows sheared."""
    (cos, sin), (cx, cy) = turn, centre
    m = scale * np.array([[cos, -sin + shear, 0.0], [sin, cos, 0.0]])
    m[:, 2] = [scale * x0 - m[0] @ [cx, cy, 0], 500 - m[1] @ [cx, cy, 0]]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, m, size[::-1], flags=flags, borderMode=cv2.BORDER_WRAP)


def frames(video: Video) -> Iterator[tuple[NDArray[np.uint8], float]]:
    """The frames [H, W] (or [H, W, 3] with `color`) uint8 sRGB, each with its presentation time in
    seconds."""
    truth = make_truth(video)
    rng = np.random.default_rng(video.seed + 3000)
    t, (h, w) = truth.pts_s, (video.height, video.width)
    path = _Path(video, t)
    room_picture, head_picture = _texture(video.seed % 3 + 10, 0.55), _texture(video.seed % 3 + 20, 0.35)
    bank = _noise_bank(h, w)
    row = ((np.arange(h, dtype=np.float32) + 0.5) / h)[:, None]
    yy, xx = np.mgrid[0:h, 0:w].astype(np.float32)
    velocity = np.gradient(path.turn, t) if len(t) > 1 else np.zeros(len(t))
    tint = (
        np.array([1.1, 1.0, 0.75], np.float32) if video.color else None
    )  # a warm room under a neutral flash
    for k, pts in enumerate(t):
        cos, sin = np.cos(path.roll[k]) / path.zoom[k], np.sin(path.roll[k]) / path.zoom[k]
        cx, cy = w / 2 + path.head_x[k], h * 0.55 + path.head_y[k]
        shear = velocity[k] * video.readout_s / h  # the picture moves while the rows are read
        scale = 320 / w  # textures are drawn for a width of 320

        turn, centre = (cos, sin), (cx, cy)
        background = _seen(room_picture, (h, w), scale, turn, centre, 300 + path.turn[k], shear)
        surface = _seen(head_picture, (h, w), scale, turn, centre, 300 + 0.25 * path.turn[k], 0.25 * shear)
        # an upright ellipse of 0.36 x 0.8 frame heights on shoulders, in the camera's frame
        dx, dy = (xx - cx) / (0.30 * h * path.zoom[k]), (yy - cy) / (0.42 * h * path.zoom[k])
        inside = np.clip((1 - dx * dx - dy * dy) * 6, 0, 1)
        torso = np.clip((dy - 0.75 - 0.25 * np.abs(dx)) * 6, 0, 1) * np.clip((1.9 - np.abs(dx)) * 6, 0, 1)
        body = np.maximum(inside, torso)
        facing = np.sqrt(np.clip(1 - 0.8 * (dx * dx + dy * dy), 0.08, 1))  # n.l of a frontal flash
        flash_gain = video.background_gain + body * (
            video.gain * np.maximum(facing * inside, 0.55 * torso) - video.background_gain
        )
        albedo = background + body * (surface - background)
        room = np.float32(video.room)
        if video.flicker_depth:
            # light of |sin|^2 type, averaged over the exposure
            middle = pts + row * video.readout_s + video.exposure_s / 2
            blur = np.sinc(video.flicker_hz * video.exposure_s)
            room = room * (
                1 + video.flicker_depth * blur * np.cos(2 * np.pi * video.flicker_hz * middle)
            ).astype(np.float32)
        lit = truth.lit[k][:, None].astype(np.float32)
        flash = albedo * (np.float32(max(video.room, 0.06)) * lit * flash_gain)
        exposure = np.exp(video.drift_per_s * pts)
        if tint is None:
            gain = exposure * (
                video.step[1] if video.step_at_s is not None and pts >= video.step_at_s else 1.0
            )
            linear = (albedo * room + flash) * np.float32(gain)
        else:
            channel_gain = exposure * (
                np.array(video.step) if video.step_at_s is not None and pts >= video.step_at_s else np.ones(3)
            )
            linear = (albedo * room)[..., None] * tint + flash[..., None]
            linear = linear * channel_gain.astype(np.float32)
        grain = bank[rng.integers(12)]
        y0, x0 = rng.integers(0, 64, 2)
        grain = grain[y0 : y0 + h, x0 : x0 + w]
        if tint is not None:
            grain = np.stack([grain, grain[::-1], grain[:, ::-1]], axis=-1)
        # shot noise of ~4000 electrons at white, and read noise
        linear = linear + video.noise * grain * np.sqrt(np.maximum(linear, 0) / 4000 + 1e-6)
        yield _srgb_table()[np.clip(linear * 65535, 0, 65535).astype(np.uint16)], float(pts)
