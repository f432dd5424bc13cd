"""Procedural textures of the room: full of corners, as structure from motion needs, yet quiet."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from capture.sim.noise import fractal_noise, value_noise

Texture = Callable[[int, int], np.ndarray]  # (rows, columns) to [rows, columns, 3] float32


def _grid(rows: int, columns: int) -> np.ndarray:
    """Points [rows * columns, 3] of the texels, z = 0."""
    x, y = np.meshgrid(np.arange(columns, dtype=np.float32), np.arange(rows, dtype=np.float32))
    return np.stack([x.ravel(), y.ravel(), np.zeros(rows * columns, np.float32)], axis=-1)


def _noise(rows: int, columns: int, scale: float, seed: int, octaves: int = 3) -> np.ndarray:
    return fractal_noise(_grid(rows, columns), scale, seed, octaves).reshape(rows, columns, 1)


def plain_texture(colour: tuple[float, float, float]) -> Texture:
    """One colour."""
    return lambda rows, columns: np.full((rows, columns, 3), colour, dtype=np.float32)


def wallpaper_texture(seed: int) -> Texture:
    """Paper with a printed leaf pattern, faintly stained."""

    def paint(rows: int, columns: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        ground = np.array([0.56, 0.54, 0.47]) * rng.uniform(0.9, 1.1, 3)
        print_ = ground * np.array([0.62, 0.72, 0.70])
        pattern = np.zeros((rows, columns), np.float32)
        pitch = 28
        for i, y in enumerate(range(0, rows + pitch, pitch)):
            for x in range((i % 2) * pitch // 2, columns + pitch, pitch):
                turn = float(rng.uniform(-25, 25))
                jitter = rng.integers(-2, 3, 2)
                centre = (int(x + jitter[0]), int(y + jitter[1]))
                size = (max(2, pitch // 3), max(1, pitch // 9))
                cv2.ellipse(pattern, centre, size, turn + 50, 0, 360, 1.0, -1, cv2.LINE_AA)
                cv2.ellipse(pattern, centre, size, turn - 50, 0, 360, 0.7, -1, cv2.LINE_AA)
        mixed = ground + pattern[..., None] * (print_ - ground)
        return (mixed * (1 + 0.10 * _noise(rows, columns, 60, seed + 1))).astype(np.float32)

    return paint


def wood_texture(seed: int, brightness: float) -> Texture:
    """Boards with grain, knots and dark joints."""

    def paint(rows: int, columns: int) -> np.ndarray:
        points = _grid(rows, columns) * np.array([0.05, 1.0, 1.0], np.float32)
        warp = value_noise(_grid(rows, columns), 60.0, seed + 2) * 9.0
        points[:, 1] += warp
        grain = fractal_noise(points, 5.0, seed + 3, 3).reshape(rows, columns, 1)
        board = (np.arange(rows) // 48)[:, None, None]
        tone = np.random.default_rng(seed).uniform(0.75, 1.15, 400)[board % 400]
        colour = np.array([0.30, 0.17, 0.085]) * brightness * tone * (1 + 0.35 * grain)
        colour = np.where((np.arange(rows) % 48 < 2)[:, None, None], colour * 0.35, colour)
        return np.clip(colour, 0.01, 0.9).astype(np.float32)

    return paint


def carpet_texture(seed: int) -> Texture:
    """A woven rug with bands."""

    def paint(rows: int, columns: int) -> np.ndarray:
        y, x = np.mgrid[0:rows, 0:columns]
        ring = np.minimum(np.minimum(x, columns - x), np.minimum(y, rows - y)) // 12
        tones = np.random.default_rng(seed).normal(1.0, 0.25, (64, 1)).clip(0.4, 1.6) * np.array(
            [0.16, 0.12, 0.10]
        )
        return (tones[ring % 64] * (1 + 0.3 * _noise(rows, columns, 2.5, seed, 2))).astype(np.float32)

    return paint


def poster_texture(seed: int) -> Texture:
    """A framed abstract print: discs, bars and lines in a few colours."""

    def paint(rows: int, columns: int) -> np.ndarray:
        rng = np.random.default_rng(seed + 77)
        palette = rng.uniform(0.03, 0.6, (5, 3))
        picture = np.full((rows, columns, 3), palette[0] * 0.5 + 0.3, dtype=np.float32)
        for _ in range(26):
            colour = tuple(float(c) for c in palette[rng.integers(1, 5)] * rng.uniform(0.6, 1.2))
            x, y = int(rng.integers(columns)), int(rng.integers(rows))
            size = int(rng.integers(4, max(5, columns // 5)))
            kind = rng.integers(3)
            if kind == 0:
                cv2.circle(picture, (x, y), size, colour, -1, cv2.LINE_AA)
            elif kind == 1:
                cv2.rectangle(picture, (x, y), (x + size * 2, y + size), colour, -1)
            else:
                cv2.line(
                    picture,
                    (x, y),
                    (int(rng.integers(columns)), int(rng.integers(rows))),
                    colour,
                    3,
                    cv2.LINE_AA,
                )
        picture *= 1 + 0.15 * _noise(rows, columns, 9, seed)
        border = max(3, round(0.035 * columns))
        for inset, tone in ((0, 0.03), (border // 2, 0.62)):
            frame = np.ones((rows, columns), bool)
            frame[
                inset + border // 2 : rows - inset - border // 2,
                inset + border // 2 : columns - inset - border // 2,
            ] = 0
            frame[:inset], frame[rows - inset :], frame[:, :inset], frame[:, columns - inset :] = 0, 0, 0, 0
            picture[frame] = tone
        return picture.astype(np.float32)

    return paint


def bookshelf_texture(seed: int) -> Texture:
    """Shelves of books, each with its own height, colour and label."""

    def paint(rows: int, columns: int) -> np.ndarray:
        rng = np.random.default_rng(seed + 33)
        picture = np.full((rows, columns, 3), 0.025, dtype=np.float32)
        shelf = 100
        for top in range(0, rows, shelf):
            x = 6
            while x < columns - 8:
                thick = int(rng.integers(6, 16))
                tall = int(rng.integers(58, 84))
                base = min(top + shelf - 8, rows)
                colour = rng.uniform(0.03, 0.5, 3) * rng.uniform(0.3, 1.0)
                if rng.random() < 0.9:
                    picture[max(base - tall, top + 4) : base, x : min(x + thick, columns - 6)] = colour
                    label = base - int(rng.integers(25, 50))
                    picture[label : label + 6, x + 1 : min(x + thick - 1, columns - 6)] = colour * 0.3 + 0.25
                    picture[max(base - tall, top + 4) : base, x : x + 1] *= 0.3
                x += thick
            picture[min(top + shelf - 8, rows - 1) : top + shelf] = (0.22, 0.12, 0.06)
        picture[:, :6] = picture[:, -6:] = (0.22, 0.12, 0.06)
        picture *= 1 + 0.12 * _noise(rows, columns, 4, seed)
        return picture.astype(np.float32)

    return paint


def window_texture(seed: int) -> Texture:
    """Overcast sky over roofs behind a white cross-barred frame; radiance, not reflectance."""

    def paint(rows: int, columns: int) -> np.ndarray:
        height = np.linspace(0, 1, rows)[:, None, None]
        clouds = _noise(rows, columns, 90, seed + 9, 4)
        sky = np.array([3.2, 3.5, 4.0]) * (1.0 + 0.22 * clouds) * (1.0 - 0.25 * height)
        ridge = 0.78 + 0.12 * value_noise(_grid(1, columns), 40, seed + 10).reshape(1, columns, 1)
        picture = np.where(height > ridge, np.array([0.55, 0.5, 0.45]) * (1 + 0.4 * clouds), sky)
        bar = max(2, rows // 60)
        for y in (0, rows // 2, rows - bar * 2):
            picture[y : y + bar * 2] = 0.5
        for x in (0, columns // 2, columns - bar * 2):
            picture[:, x : x + bar * 2] = 0.5
        return picture.astype(np.float32)

    return paint
