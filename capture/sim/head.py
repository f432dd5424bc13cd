"""The shape of a head, neck and shoulders as one implicit surface, sculpted from smooth unions.

Head frame, in MILLIMETRES: +Y up, +Z where the face looks, +X the subject's left, the origin between the
eyes' height and the middle of the skull (the head spans about y = -118 .. 115). The rest of the rig uses the
same axes in metres. The body is mirrored in x and then bent a little, as faces are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.sim.noise import value_noise
from capture.sim.sdf import (
    bump,
    capsule,
    ellipsoid,
    round_cone,
    smooth_step,
    smooth_subtract,
    smooth_union,
    sphere,
)
from capture.sim.subject import Subject

EYE_CENTRE = (32.0, 0.0, 73.5)
EYE_RADIUS = 12.0
MOUTH_HEIGHT = -76.0
BUST_FLOOR = -352.0
BOUNDS = (np.array([-266.0, -360.0, -140.0]), np.array([266.0, 136.0, 140.0]))


@dataclass(frozen=True)
class HeadShape:
    """The implicit surface of one subject; every method takes points [P, 3] in head millimetres."""

    subject: Subject

    def fold(self, points: np.ndarray) -> np.ndarray:
        """Points of the symmetric head: asymmetry taken out, x made positive (towards the left ear)."""
        folded = np.array(points, dtype=np.float32)
        folded[:, :2] += self._asymmetry(points)
        folded[:, 0] = np.abs(folded[:, 0]) / self._width(folded[:, 1])
        return folded

    def unfold(self, points: np.ndarray) -> np.ndarray:
        """Where points of the symmetric head (x of either sign) really are: `fold` undone, to 0.05 mm."""
        real = np.array(points, dtype=np.float32)
        real[:, 0] *= self._width(real[:, 1])
        real[:, :2] -= self._asymmetry(real)
        return real

    def _asymmetry(self, points: np.ndarray) -> np.ndarray:
        phase = np.random.default_rng(self.subject.seed + 7).uniform(0.0, 2.0 * np.pi, 2).astype(np.float32)
        sideways = 0.8 * np.sin(points[:, 1] / 23.0 + phase[0]) * np.sin(points[:, 2] / 31.0)
        return np.stack([sideways, 0.9 * np.sin(points[:, 0] / 29.0 + phase[1])], axis=-1)

    def _width(self, height: np.ndarray) -> np.ndarray:
        s = self.subject
        width = s.head_width * (1.0 + (s.jaw_width - 1.0) * smooth_step(height, -10.0, -70.0))
        return 1.0 + smooth_step(height, -170.0, -110.0) * (width - 1.0)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [P] to skin and shirt together (no eyeballs, no hair)."""
        q = self.fold(points)
        skin = self._skin(q)
        shirt = self._shirt(q)
        return np.maximum(smooth_union(skin, shirt, 1.5), BUST_FLOOR - points[:, 1])

    def shirt_mask(self, points: np.ndarray) -> np.ndarray:
        """1 on the shirt, 0 on skin; [P]."""
        q = self.fold(points)
        return smooth_step(self._skin(q) - self._shirt(q), -0.6, 0.6)

    def collar(self, points: np.ndarray) -> np.ndarray:
        """Distance [P] from the neckline, positive on the shirt's side; far positive above the neck."""
        q = self.fold(points)
        return np.where(q[:, 1] < -100.0, self._below_collar(q), 1e3)

    def _skin(self, q: np.ndarray) -> np.ndarray:
        # The neck and the body are far from most points of the face and the other way round: skip what
        # cannot touch.
        result = np.empty(len(q), dtype=np.float32)
        face = q[:, 1] > -60.0
        below = q[:, 1] < -175.0
        middle = ~(face | below)
        result[face] = self._head(q[face])
        result[below] = self._body(q[below])
        result[middle] = smooth_union(self._head(q[middle]), self._body(q[middle]), 16.0)
        # Behind and above the collar the neck joins the skull inside the range of the first rule.
        nape = face & (q[:, 2] < 40.0) & (q[:, 1] < 0.0)
        result[nape] = smooth_union(result[nape], self._body(q[nape]), 16.0)
        return result

    def _head(self, q: np.ndarray) -> np.ndarray:
        s = self.subject
        d = ellipsoid(q, (0, 34, -14), (73, 79, 92))
        d = smooth_union(d, ellipsoid(q, (0, 40, 22), (60, 54, 62)), 24)
        d = smooth_union(d, ellipsoid(q, (0, -22, 22), (59, 79, 64)), 22)
        d = smooth_union(d, round_cone(q, (47, -60, 9), (11, -101, 66), (12.5, 11)), 26)
        d = smooth_union(d, ellipsoid(q, (0, -102, 70 + 6 * (s.chin - 1)), (16, 14, 16 * s.chin)), 18)
        d = smooth_union(d, ellipsoid(q, (45, -22, 50), (17, 11, 22)), 22)
        d = smooth_union(d, ellipsoid(q, (33, -50, 48), (27, 34, 30)), 20)
        d = smooth_union(d, ellipsoid(q, (0, -72, 62), (32, 28, 27)), 16)
        d = smooth_union(d, capsule(q, (9, 16, 79), (42, 19, 62), 6.5 * s.brow), 24)
        d = smooth_subtract(d, ellipsoid(q, (30, 2, 96), (18, 9.5, 16)), 14)
        d = self._eyelids(q, d)
        d = self._nose(q, d)
        d = self._mouth(q, d)
        return self._ear(q, d)

    def _eyelids(self, q: np.ndarray, d: np.ndarray) -> np.ndarray:
        near = np.linalg.norm(q - np.array(EYE_CENTRE, np.float32), axis=-1) < 34.0
        if not near.any():
            return d
        p, skin = q[near], d[near]
        skin = smooth_union(skin, sphere(p, EYE_CENTRE, EYE_RADIUS + 1.4), 6.5)
        over, under, forward = self._lid_margins(p)
        crease = bump(over, 3.6, 1.0) * smooth_step(forward, 0.0, 6.0) * bump(p[:, 0], EYE_CENTRE[0], 9.0)
        bag = bump(under, 5.5, 2.2) * smooth_step(forward, 0.0, 6.0) * bump(p[:, 0], EYE_CENTRE[0], 9.0)
        skin = skin + 0.9 * crease - 0.25 * bag
        shell = EYE_RADIUS - 1.0 - np.linalg.norm(p - np.array(EYE_CENTRE, np.float32), axis=-1)
        opening = np.maximum(np.maximum(over, under), np.maximum(1.0 - forward, shell))
        result = d.copy()
        result[near] = smooth_subtract(skin, opening, 0.8)
        return result

    def _lid_margins(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights [P] above the upper lid's edge and below the lower's, and depth before the eye's centre."""
        e = q - np.array(EYE_CENTRE, np.float32)
        level = e[:, 1] - 0.07 * e[:, 0]
        u = np.clip(e[:, 0] / 13.8, -1.4, 1.4)
        upper = 5.0 * (1.0 - np.abs(u) ** 2.2) - 0.9 * u * (1.0 - u * u)
        lower = 4.3 * (1.0 - u * u)
        return 0.9 * (level - upper), 0.9 * (-level - lower), e[:, 2]

    def lid_line(self, points: np.ndarray) -> np.ndarray:
        """1 along the lids' edges (lash line), 0 elsewhere; [P]."""
        q = self.fold(points)
        over, under, forward = self._lid_margins(q)
        near = (np.linalg.norm(q - np.array(EYE_CENTRE, np.float32), axis=-1) < 19.0) & (forward > 3.0)
        return near * bump(np.maximum(over, under), 0.3, 0.55)

    def _nose(self, q: np.ndarray, d: np.ndarray) -> np.ndarray:
        near = (q[:, 0] < 40) & (q[:, 2] > 50) & (q[:, 1] > -85) & (q[:, 1] < 45)
        if not near.any():
            return d
        s, p, skin = self.subject, q[near], d[near]
        out, wide = 22.0 * (s.nose_length - 1.0), s.nose_width
        skin = smooth_union(skin, round_cone(p, (0, 20, 75.5), (0, -33, 97.5 + out), (7.0, 9.3)), 15)
        skin = smooth_union(skin, ellipsoid(p, (0, -39.5, 100.5 + out), (8.8 * wide, 7.6, 9.5)), 9)
        skin = smooth_union(skin, ellipsoid(p, (12.0 * wide, -43, 91 + out), (6.6, 6.6, 10.5)), 8)
        skin = smooth_union(skin, capsule(p, (0, -46, 101 + out), (0, -53, 83), 3.2), 6)
        nostril = ellipsoid(p, (6.8 * wide, -50.5, 96 + out), (3.0, 4.5, 5.0))
        skin = smooth_subtract(skin, nostril, 2.2)
        groove = capsule(p, (19.0 * wide, -42, 90), (32, -72, 84), 2.0)
        skin = smooth_subtract(skin, groove, 7.0)
        result = d.copy()
        result[near] = skin
        return result

    def _lip_borders(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights [P] of the upper and the lower border of the red of the lips at |x|."""
        full = self.subject.lip_fullness
        arch = np.sqrt(np.clip(1.0 - (x / 23.5) ** 2, 0.0, 1.0))
        bow = 1.0 + 0.10 * bump(x, 5.5, 3.0) - 0.16 * bump(x, 0.0, 2.2)
        sag = 0.8 * (x / 23.5) ** 2
        upper = MOUTH_HEIGHT + sag + 7.6 * full * arch**1.4 * bow
        return upper, MOUTH_HEIGHT + sag - 9.4 * full * arch**1.2

    def lip_mask(self, points: np.ndarray) -> np.ndarray:
        """1 on the red of the lips, 0 elsewhere, soft over about 1.5 mm; [P]."""
        q = self.fold(points)
        upper, lower = self._lip_borders(q[:, 0])
        edge = np.minimum(upper - q[:, 1], q[:, 1] - lower)
        return smooth_step(edge, -0.5, 1.0) * (q[:, 2] > 66) * (q[:, 0] < 23.5)

    def _mouth(self, q: np.ndarray, d: np.ndarray) -> np.ndarray:
        near = (q[:, 0] < 45) & (q[:, 2] > 45) & (q[:, 1] > -118) & (q[:, 1] < -45)
        if not near.any():
            return d
        p, skin, full = q[near], d[near], self.subject.lip_fullness
        skin = smooth_subtract(skin, capsule(p, (0, -54, 94.5), (0, -65, 93.5), 2.0), 4.5)
        skin = smooth_subtract(skin, ellipsoid(p, (0, -91, 96), (17, 4.0, 7.0)), 9)
        # The lips are arcs: what is at x lies back by the curvature of the teeth.
        back = p[:, 0] ** 2 * np.float32(0.0155)
        bent = p.copy()
        bent[:, 2] += back
        bent[:, 1] -= 0.8 * (p[:, 0] / 23.5) ** 2
        taper = np.sqrt(np.clip(1.0 - (p[:, 0] / 27.0) ** 2, 0.0, 1.0))
        tube = bent.copy()
        tube[:, 0] = np.maximum(bent[:, 0] - 21.0, 0.0)
        rise = 0.9 * bump(p[:, 0], 5.5, 3.5)
        tube[:, 1] -= rise
        upper = ellipsoid(tube, (0, MOUTH_HEIGHT + 3.2 * full, 86.5), (4.5, 4.6 * full, 6.8)) + 2.6 * (
            1 - taper
        )
        skin = smooth_union(skin, upper, 2.6)
        tube[:, 1] += rise
        lower = ellipsoid(tube, (0, MOUTH_HEIGHT - 4.2 * full, 85.5), (4.5, 5.2 * full, 7.2)) + 3.2 * (
            1 - taper
        )
        skin = smooth_union(skin, lower, 2.6)
        tube[:, 0] = np.maximum(bent[:, 0] - 24.0, 0.0)
        seam = ellipsoid(tube, (0, MOUTH_HEIGHT, 95.5), (2.2, 0.9, 7.0))
        result = d.copy()
        result[near] = smooth_subtract(skin, seam, 1.6)
        return result

    def _ear(self, q: np.ndarray, d: np.ndarray) -> np.ndarray:
        near = (q[:, 0] > 45) & (np.abs(q[:, 2] + 12) < 50) & (np.abs(q[:, 1] + 8) < 60)
        if not near.any():
            return d
        skin = d[near]
        # Ear frame: u back along the ear's plane, v up, w outwards; leaning back and standing off the skull.
        size = np.float32(self.subject.ear_size)
        lean, flare = np.radians(12.0), np.radians(22.0)
        o = (q[near] - np.array([63.5, -10.0, -4.0], np.float32)) / size
        v = o[:, 1] * np.cos(lean) - o[:, 2] * np.sin(lean)
        back = -o[:, 2] * np.cos(lean) - o[:, 1] * np.sin(lean)
        u = back * np.cos(flare) + o[:, 0] * np.sin(flare)
        w = o[:, 0] * np.cos(flare) - back * np.sin(flare)
        e = np.stack([u, v, w], axis=-1).astype(np.float32)
        outline_u = 10.0 + 3.0 * smooth_step(v, -30.0, 10.0)
        half = 1.0 - 0.28 * smooth_step(v, 0.0, -30.0)
        plan = (np.abs((u - outline_u) / (17.0 * half)) ** 2.4 + np.abs(v / 31.0) ** 2.4) ** np.float32(
            1 / 2.4
        )
        plate = np.maximum((plan - 1.0) * 16.0, np.abs(w - 2.0 - 1.0 * plan) - 2.0)
        rim = np.hypot((plan - 0.90) * 17.0, w - 4.6) - 2.7
        rim = np.where(v < -14.0, rim + 0.25 * (-14.0 - v), rim)
        fold = np.hypot((np.hypot((u - 11.0) / 10.5, (v - 2.0) / 20.0) - 0.95) * 10.0, w - 4.0) - 2.0
        fold += 3.0 * smooth_step(u, 8.0, 0.0)
        lobe = ellipsoid(e, (6.0, -24.0, 2.5), (8.5, 9.0, 3.6))
        tragus = ellipsoid(e, (0.5, -6.0, 3.5), (4.0, 6.5, 4.0))
        ear = smooth_union(smooth_union(plate, rim, 2.5), smooth_union(fold, lobe, 2.5), 2.5)
        concha = ellipsoid(e, (9.0, -6.0, 8.6), (7.5, 10.5, 6.4))
        ear = smooth_subtract(ear, concha, 2.0)
        ear = smooth_union(ear, tragus, 2.5)
        result = d.copy()
        result[near] = smooth_union(skin, ear * size, 5.0)
        return result

    def _torso(self, q: np.ndarray) -> np.ndarray:
        wide = self.subject.neck_width
        d = round_cone(q, (0, -60, -22), (0, -190, -38), (49 * wide, 51 * wide))
        d = smooth_union(d, capsule(q, (53 * wide, -48, -22), (12, -190, 8), 8.0), 16)
        d = smooth_union(d, ellipsoid(q, (0, -128, 21 * wide), (6, 13, 7.5)), 16)
        d = smooth_union(d, round_cone(q, (20, -124, -58), (136, -208, -48), (22, 32)), 36)
        d = smooth_union(d, capsule(q, (0, -246, -36), (158, -244, -44), 46), 40)
        d = smooth_union(d, ellipsoid(q, (0, -318, -26), (160, 142, 84)), 40)
        d = smooth_union(d, capsule(q, (178, -250, -42), (204, -420, -38), 46), 26)
        return smooth_union(d, capsule(q, (12, -200, 22), (128, -200, -4), 6.0), 18)

    def _body(self, q: np.ndarray) -> np.ndarray:
        return smooth_subtract(self._torso(q), ellipsoid(q, (0, -196, 33), (9, 10, 12)), 18)

    def _below_collar(self, q: np.ndarray) -> np.ndarray:
        """Distance [P] below the neckline, which is low in front and high at the nape."""
        drop = -q[:, 1] - 0.5 * (q[:, 2] + 60.0) - 146.0
        side = q[:, 0] - 42.0
        return (drop + 0.45 * (side + np.sqrt(side * side + 900.0))) * np.float32(0.7)

    def _shirt(self, q: np.ndarray) -> np.ndarray:
        result = np.full(len(q), 1e3, dtype=np.float32)
        near = q[:, 1] < -100.0
        p = q[near]
        below = self._below_collar(p)
        folds = value_noise(p * np.array([1.0, 0.45, 1.0], np.float32), 34.0, self.subject.seed + 21)
        wrinkle = 2.2 * folds * smooth_step(below, 10.0, 60.0)
        rib = 1.6 * smooth_step(np.abs(below - 9.0), 9.5, 8.0)
        cloth = self._torso(p) - 5.5 - wrinkle - rib
        result[near] = smooth_subtract(cloth, below, 1.5)
        return result
