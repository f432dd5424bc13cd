"""PLY point clouds: ascii and binary, either byte order.

The vertex element must come first, as every writer of point clouds has it; it may carry any scalar properties
besides x, y, z, nx, ny, nz and red, green, blue. Later elements (faces, with their lists) are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.atomic import atomic_write
from capture.errors import SourceError

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LARGEST_HEADER = 1 << 16


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the world.

    Attributes:
        points: [P, 3] float32 or float64, as stored; metres where the scene is metric.
        normals: [P, 3] float32, as stored (not normalised), None = none.
        colors: [P, 3] float32, 0..1, display-referred as clouds commonly are, None = none.
    """

    points: NDArray[Any]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None


def read_ply(path: Path) -> PointCloud:
    """Reads a point cloud.

    Raises:
        SourceError: missing, malformed, cut short, empty, or with coordinates that are not finite.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as cause:
        raise SourceError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    order, count, properties, body = _header(data, path)
    for axis in "xyz":
        if axis not in properties:
            raise SourceError(f"{path}: the vertices have no property {axis!r}.")
    if count == 0:
        raise SourceError(f"{path} holds no points.")
    table = (
        _ascii_table(data, body, count, properties, path)
        if order == ""
        else _binary_table(data, body, count, properties, order, path)
    )
    points = _columns(table, ("x", "y", "z"))
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise SourceError(f"{path}: point {bad} has a coordinate that is not finite; clean the cloud first.")
    normals = colors = None
    if {"nx", "ny", "nz"} <= properties.keys():
        normals = _columns(table, ("nx", "ny", "nz")).astype(np.float32)
    if {"red", "green", "blue"} <= properties.keys():
        stored = _columns(table, ("red", "green", "blue"))
        white = np.iinfo(stored.dtype).max if stored.dtype.kind in "iu" else 1
        colors = (stored / np.float32(white)).astype(np.float32)
    return PointCloud(points, normals, colors)


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Writes a binary little-endian PLY: points in their precision, normals as float, colours as uchar."""
    count = len(cloud.points)
    real = "f8" if cloud.points.dtype == np.float64 else "f4"
    columns: list[tuple[str, str, NDArray[Any]]] = [
        (a, real, cloud.points[:, i]) for i, a in enumerate("xyz")
    ]
    if cloud.normals is not None:
        columns += [(name, "f4", cloud.normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if cloud.colors is not None:
        codes = np.round(np.clip(cloud.colors, 0.0, 1.0) * 255.0)
        columns += [(name, "u1", codes[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    table = np.empty(count, np.dtype([(name, "<" + code) for name, code, _ in columns]))
    for name, _, values in columns:
        table[name] = values
    words = {"f8": "double", "f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {words[code]} {name}" for name, code, _ in columns]
    atomic_write(path, "\n".join([*lines, "end_header", ""]).encode() + table.tobytes())


def _header(data: bytes, path: Path) -> tuple[str, int, dict[str, str], int]:
    """(byte order, number of vertices, {property: type code}, offset of the body)."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise SourceError(f"{path} is no PLY file (it does not begin with 'ply').")
    end = data.find(b"end_header", 0, _LARGEST_HEADER)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise SourceError(f"{path} has no complete PLY header.")
    order: str | None = None
    count = -1
    elements = 0
    properties: dict[str, str] = {}
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", name, _] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
            case ["element", name, number]:
                elements += 1
                if elements == 1:
                    if name != "vertex" or not number.isdecimal() or len(number) > 15:
                        raise SourceError(
                            f"{path}: the first element must be 'vertex' with a count, not {line.strip()!r}."
                        )
                    count = int(number)
            case ["property", *_] if elements > 1:
                pass
            case ["property", kind, name] if elements == 1 and kind in _TYPES and name not in properties:
                properties[name] = _TYPES[kind]
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise SourceError(f"{path}: the header line {line.strip()[:60]!r} is not understood.")
    if order is None or count < 0:
        raise SourceError(f"{path}: the header names no known format or no vertices.")
    return order, count, properties, newline + 1


def _binary_table(
    data: bytes, body: int, count: int, properties: dict[str, str], order: str, path: Path
) -> NDArray[Any]:
    row = np.dtype([(name, order + code) for name, code in properties.items()])
    present = (len(data) - body) // row.itemsize
    if present < count:
        raise SourceError(
            f"{path} is cut short: its header promises {count} points, the file holds {present}."
        )
    return np.frombuffer(data, row, count, body)


def _ascii_table(data: bytes, body: int, count: int, properties: dict[str, str], path: Path) -> NDArray[Any]:
    if count * 2 * len(properties) > len(data) - body + 1:  # a digit and a separator for each number
        raise SourceError(
            f"{path} is cut short: its header promises {count} points, more than the file can hold."
        )
    size = count * len(properties)
    words = data[body:].split(None, size)[:size]
    if len(words) < size:
        raise SourceError(
            f"{path} is cut short: its header promises {count} points, the file ends before them."
        )
    try:
        numbers = np.array(words).astype(np.float64).reshape(count, len(properties))
    except ValueError as cause:
        raise SourceError(f"{path}: the points cannot be read as numbers: {cause}.") from cause
    table = np.empty(count, np.dtype(list(properties.items())))
    with np.errstate(invalid="ignore", over="ignore"):
        for i, name in enumerate(properties):
            table[name] = numbers[:, i]
    return table


def _columns(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[Any]:
    """[P, n] native-order array of some properties, in the precision they share."""
    kind = np.result_type(*(table.dtype[name] for name in names)).newbyteorder("=")
    return np.stack([table[name] for name in names], axis=-1).astype(kind, copy=False)
