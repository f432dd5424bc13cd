"""DNG opcode lists: what a camera asks for beyond levels and demosaicing (DNG 1.7.1, chapter 7).

Two kinds change radiance and are carried out: GainMap (lens shading, by colour plane) and FixVignetteRadial.
The others are named: warps would resample, bad pixels and tables are LibRaw's or rare. An opcode list is
big-endian whatever the file is.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import ImageError

_NAMES = {
    1: "WarpRectilinear",
    2: "WarpFisheye",
    3: "FixVignetteRadial",
    4: "FixBadPixelsConstant",
    5: "FixBadPixelsList",
    6: "TrimBounds",
    7: "MapTable",
    8: "MapPolynomial",
    9: "GainMap",
    10: "DeltaPerRow",
    11: "DeltaPerColumn",
    12: "ScalePerRow",
    13: "ScalePerColumn",
    14: "WarpRectilinear2",
}
_VIGNETTE, _GAIN_MAP = 3, 9
_OPTIONAL = 1  # flag: may be left out
_AREA = struct.Struct(">8I")  # top, left, bottom, right, plane, planes, row pitch, column pitch
_MAP = struct.Struct(">2I4dI")  # points, spacing, origin (each vertical, horizontal), planes
_MOST_OPCODES = 256  # phones write four gain maps and a warp or two
# Of a gain map or a vignette's corner. Lenses lose up to four stops there (16); more is a damaged file.
_LARGEST_GAIN = 64.0

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class GainMap:
    """Gains on a grid, for every so many rows and columns of an area (DNG 1.7.1, GainMap).

    Attributes:
        area: top, left, bottom, right in pixels of the picture; bottom and right are outside.
        planes: first plane and number of planes.
        pitch: rows and columns from one pixel that is changed to the next.
        spacing: of the grid, vertical and horizontal, in heights and widths of the picture.
        origin: of the grid, likewise.
        gain: [V, H, P]; the last plane holds for all that follow.
    """

    area: tuple[int, int, int, int]
    planes: tuple[int, int]
    pitch: tuple[int, int]
    spacing: tuple[float, float]
    origin: tuple[float, float]
    gain: Floats

    @property
    def largest(self) -> float:
        """The largest gain."""
        return float(self.gain.max())

    def apply(self, picture: Floats) -> None:
        """Multiplies a picture, [H, W] or [H, W, C], in place; nothing is clipped."""
        height, width = picture.shape[:2]
        top, left, bottom, right = self.area
        rows = np.arange(top, min(bottom, height), self.pitch[0])
        columns = np.arange(left, min(right, width), self.pitch[1])
        if not len(rows) or not len(columns):
            return
        stack = picture[..., None] if picture.ndim == 2 else picture
        first, count = self.planes
        part = np.s_[rows[0] : rows[-1] + 1 : self.pitch[0], columns[0] : columns[-1] + 1 : self.pitch[1]]
        for plane in range(first, min(first + count, stack.shape[2])):
            gain = self.gain[..., min(plane, self.gain.shape[2] - 1)]
            gain = _interpolated(gain, (rows + 0.5) / height, self.spacing[0], self.origin[0])
            gain = _interpolated(gain.T, (columns + 0.5) / width, self.spacing[1], self.origin[1]).T
            stack[(*part, plane)] *= gain


@dataclass(frozen=True, eq=False)
class VignetteRadial:
    """A gain 1 + k0 r^2 + ... + k4 r^10, r = 1 in the corner farthest from the centre (FixVignetteRadial).

    Attributes:
        coefficients: k0..k4.
        centre: x and y in widths and heights of the picture.
    """

    coefficients: tuple[float, ...]
    centre: tuple[float, float]

    @property
    def largest(self) -> float:
        """The largest gain within the picture."""
        return float(self._gain(np.linspace(0.0, 1.0, 1025)).max())

    def apply(self, picture: Floats) -> None:
        """Multiplies a picture, [H, W] or [H, W, C], in place; nothing is clipped."""
        height, width = picture.shape[:2]
        x, y = self.centre[0] * width, self.centre[1] * height
        farthest = max(x, width - x) ** 2 + max(y, height - y) ** 2
        across, down = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y
        gain = self._gain((across[None] ** 2 + down[:, None] ** 2) / farthest).astype(np.float32)
        picture *= gain if picture.ndim == 2 else gain[..., None]

    def _gain(self, square: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.polynomial.polynomial.polyval(square, (1.0, *self.coefficients)))


@dataclass(frozen=True, eq=False)
class OpcodeList:
    """What an opcode list asks for.

    Attributes:
        steps: those that are carried out, in order.
        left_out: names of the others.
        missed: names of those of them without which the file says that the picture is not right.
    """

    steps: tuple[GainMap | VignetteRadial, ...] = ()
    left_out: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()

    def apply(self, picture: Floats) -> None:
        """Carries the steps out on [H, W] or [H, W, C], in place."""
        for step in self.steps:
            step.apply(picture)

    @property
    def largest_gain(self) -> float:
        """A bound on the gain of any pixel: the largest of each plane and phase, multiplied."""
        by_place: dict[Any, float] = {}
        everywhere = 1.0
        for step in self.steps:
            if isinstance(step, GainMap):
                place = (step.area[:2], step.planes, step.pitch)
                by_place[place] = by_place.get(place, 1.0) * max(step.largest, 1.0)
            else:
                everywhere *= max(step.largest, 1.0)
        disjoint = _are_disjoint([s for s in self.steps if isinstance(s, GainMap)])
        gains = list(by_place.values()) or [1.0]
        return everywhere * float(max(gains) if disjoint else np.prod(gains))


def parse_opcodes(data: bytes, done: Collection[str] = ()) -> OpcodeList:
    """The opcodes of an OpcodeList1, 2 or 3.

    Args:
        data: the list.
        done: names of opcodes that have been carried out already.

    Raises:
        ImageError: malformed; the sentence lacks the file's name.
    """
    if len(data) < 4:
        raise ImageError(f"an opcode list of {len(data)} bytes is cut short")
    (count,) = struct.unpack_from(">I", data)
    if count > _MOST_OPCODES:
        raise ImageError(f"an opcode list claims {count} opcodes; at most {_MOST_OPCODES} are read")
    steps: list[GainMap | VignetteRadial] = []
    left_out, missed = [], []
    place = 4
    for _ in range(count):
        if place + 16 > len(data):
            raise ImageError("an opcode list is cut short")
        code, _, flags, size = struct.unpack_from(">4I", data, place)
        body = data[place + 16 : place + 16 + size]
        if len(body) < size:
            raise ImageError(f"the opcode {_name(code)} claims {size} bytes, {len(body)} are there")
        place += 16 + size
        if code == _GAIN_MAP:
            steps.append(_gain_map(body))
        elif code == _VIGNETTE:
            steps.append(_vignette(body))
        elif _name(code) not in done:
            left_out.append(_name(code))
            missed += [] if flags & _OPTIONAL else [_name(code)]
    return OpcodeList(tuple(steps), tuple(left_out), tuple(missed))


def _gain_map(body: bytes) -> GainMap:
    head = _AREA.size + _MAP.size
    if len(body) < head:
        raise ImageError(f"a GainMap of {len(body)} bytes is cut short")
    top, left, bottom, right, plane, planes, row_pitch, column_pitch = _AREA.unpack_from(body)
    down, across, *grid, map_planes = _MAP.unpack_from(body, _AREA.size)
    if min(row_pitch, column_pitch, planes, down, across, map_planes) < 1 or bottom < top or right < left:
        raise ImageError("a GainMap has an empty grid, no planes, no pitch or an area of negative size")
    if 4 * down * across * map_planes != len(body) - head:
        raise ImageError(
            f"a GainMap claims {down} x {across} points in {map_planes} planes, for which "
            f"{len(body) - head} bytes are there"
        )
    spacing = [grid[0] if down > 1 else 1.0, grid[1] if across > 1 else 1.0]
    if not np.isfinite([*spacing, *grid[2:]]).all() or min(spacing) <= 0:
        raise ImageError("a GainMap's grid has no positive, finite spacing and origin")
    gain = np.frombuffer(body, ">f4", offset=head).astype(np.float32).reshape(down, across, map_planes)
    if not (np.isfinite(gain) & (gain > 0) & (gain <= _LARGEST_GAIN)).all():
        raise ImageError(f"a GainMap has gains that are not in 0..{_LARGEST_GAIN:g}")
    return GainMap(
        (top, left, bottom, right),
        (plane, planes),
        (row_pitch, column_pitch),
        (spacing[0], spacing[1]),
        (grid[2], grid[3]),
        gain,
    )


def _vignette(body: bytes) -> VignetteRadial:
    if len(body) != 56:
        raise ImageError(f"a FixVignetteRadial has {len(body)} bytes, not 56")
    *coefficients, x, y = struct.unpack(">7d", body)
    vignette = VignetteRadial(tuple(coefficients), (x, y))
    if not np.isfinite([*coefficients, x, y]).all() or not (0 <= x <= 1 and 0 <= y <= 1):
        raise ImageError("a FixVignetteRadial has no finite coefficients or a centre outside the picture")
    gain = vignette._gain(np.linspace(0.0, 1.0, 1025))
    if not (0 < gain.min() <= gain.max() <= _LARGEST_GAIN):
        raise ImageError(f"a FixVignetteRadial has gains that are not in 0..{_LARGEST_GAIN:g}")
    return vignette


def _interpolated(values: Floats, at: NDArray[np.float64], spacing: float, origin: float) -> Floats:
    """[n, ...] linear between the rows of `values`, the end rows beyond; `at` in sizes of the picture."""
    last = len(values) - 1
    place = np.clip((at - origin) / spacing, 0.0, last)
    below = np.minimum(place.astype(np.intp), max(last - 1, 0))
    share = (place - below).astype(np.float32)[:, None]
    return np.asarray(values[below] * (1 - share) + values[np.minimum(below + 1, last)] * share)


def _are_disjoint(maps: list[GainMap]) -> bool:
    """Whether no pixel can be under two maps: the four phases of a mosaic, or one map a plane."""
    places = {(m.area[0] % m.pitch[0], m.area[1] % m.pitch[1], m.planes) for m in maps}
    one_pitch = len({m.pitch for m in maps}) <= 1
    return one_pitch and len(places) == len(maps) and all(m.planes[1] == 1 for m in maps)


def _name(code: int) -> str:
    return _NAMES.get(code, f"number {code}")
