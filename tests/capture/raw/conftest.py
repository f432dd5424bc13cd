"""A small writer of DNG files (DNG 1.7.1): uncompressed 16-bit mosaics, tags that radiometry needs."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest

SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8, 11: 4, 12: 8}
CODES = {1: "B", 3: "H", 4: "I", 7: "B", 9: "i", 11: "f", 12: "d"}
PATTERNS = {"RGGB": (0, 1, 1, 2), "BGGR": (2, 1, 1, 0), "GRBG": (1, 0, 2, 1), "GBRG": (1, 2, 0, 1)}
XTRANS = ["GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB", "RBGBRG"]
# XYZ (D50) to camera of no camera in particular: well conditioned, so that LibRaw has a matrix to work with
MATRIX = (0.9, -0.2, -0.1, -0.4, 1.2, 0.2, -0.1, 0.2, 0.6)


def rational(values, scale=1 << 20, signed=False):
    kind = 10 if signed else 5
    return kind, [
        number for value in np.atleast_1d(values) for number in (round(float(value) * scale), scale)
    ]


def packed(kind, values, order):
    if kind == 2:
        return values.encode() + b"\0"
    if isinstance(values, bytes):
        return values
    code = {5: "I", 10: "i"}.get(kind) or CODES[kind]
    return struct.pack(f"{order}{len(values)}{code}", *values)


def tiff(order, directories, strip):
    """A file of main directory, sub-directories and Exif; each a dict tag -> (type, values).

    `directories` has the keys "main", "raw" and "exif". The strip's offset and size are filled in.
    """
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    names = list(directories)
    entries = {name: dict(fields) for name, fields in directories.items()}
    holder = "raw" if "raw" in entries else "main"
    entries[holder] |= {273: (4, [0]), 279: (4, [len(strip)])}
    if "raw" in entries:
        entries["main"][330] = (4, [0])
    if "exif" in entries:
        entries["main"][34665] = (4, [0])

    def lay(starts, strip_at):
        if "raw" in entries:
            entries["main"][330] = (4, [starts.get("raw", 0)])
        if "exif" in entries:
            entries["main"][34665] = (4, [starts.get("exif", 0)])
        entries[holder][273] = (4, [strip_at])
        out, places = b"", {}
        for name in names:
            places[name] = 8 + len(out)
            fields = entries[name]
            table = struct.pack(order + "H", len(fields))
            values_at = places[name] + 2 + 12 * len(fields) + 4
            values = b""
            for tag in sorted(fields):
                kind, value = fields[tag]
                data = packed(kind, value, order)
                table += struct.pack(order + "HHI", tag, kind, len(data) // SIZES[kind])
                if len(data) <= 4:
                    table += data.ljust(4, b"\0")
                else:
                    table += struct.pack(order + "I", values_at + len(values))
                    values += data + b"\0" * (len(data) % 2)
            out += table + struct.pack(order + "I", 0) + values
        return out, places

    out, places = lay({}, 0)
    out, _ = lay(places, 8 + len(out))
    return head + out + strip


def opcode(code, body, flags=1):
    return struct.pack(">4I", code, 0x01030000, flags, len(body)) + body


def opcode_list(*opcodes):
    return struct.pack(">I", len(opcodes)) + b"".join(opcodes)


def gain_map(gain, area, *, plane=0, planes=1, pitch=(1, 1), spacing=None, origin=(0.0, 0.0), flags=1):
    """A GainMap opcode; without a spacing the grid reaches from edge to edge."""
    gain = np.asarray(gain, np.float32)
    gain = gain[..., None] if gain.ndim == 2 else gain
    down, across, map_planes = gain.shape
    spacing = spacing or (1 / max(down - 1, 1), 1 / max(across - 1, 1))
    body = struct.pack(">8I", *area, plane, planes, *pitch)
    body += struct.pack(">2I4dI", down, across, *spacing, *origin, map_planes)
    return opcode(9, body + gain.astype(">f4").tobytes(), flags)


def vignette(coefficients, centre=(0.5, 0.5), flags=1):
    return opcode(3, struct.pack(">7d", *coefficients, *centre), flags)


def dng(
    mosaic,
    *,
    order="<",
    pattern="RGGB",
    black=((0.0,),),
    white=65535,
    neutral=(0.5, 1.0, 0.625),
    exposure_s=0.01,
    iso=100,
    aperture=2.0,
    time="2026:05:01 12:00:00",
    subsec="",
    orientation=1,
    opcodes2=None,
    opcodes3=None,
    table=None,
    active=None,
    delta_h=None,
    delta_v=None,
    camera=("Maker", "Model 1"),
    extra=None,
):
    """The bytes of a DNG of a mosaic [H, W] (or of [H, W, 3], demosaiced) of uint16 codes."""
    mosaic = np.asarray(mosaic, np.uint16)
    height, width = mosaic.shape[:2]
    samples = 3 if mosaic.ndim == 3 else 1
    black = np.atleast_2d(np.asarray(black, float))
    main = {
        271: (2, camera[0]),
        272: (2, camera[1]),
        274: (3, [orientation]),
        50706: (1, [1, 4, 0, 0]),
        50708: (2, " ".join(camera)),
        50721: rational(MATRIX, 10000, signed=True),
        50728: rational(neutral),
        50778: (3, [21]),
    }
    raw = {
        254: (4, [0]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [16] * samples),
        259: (3, [1]),
        262: (3, [34892 if samples == 3 else 32803]),
        277: (3, [samples]),
        278: (4, [height]),
        284: (3, [1]),
        50717: (4, [white] * samples),
    }
    if samples == 1:
        if pattern == "XTRANS":
            cells, dim = bytes("RGB".index(letter) for row in XTRANS for letter in row), [6, 6]
        else:
            cells, dim = bytes(PATTERNS[pattern]), [2, 2]
        raw |= {33421: (3, dim), 33422: (1, cells), 50710: (1, bytes([0, 1, 2])), 50711: (3, [1])}
        raw |= {50713: (3, list(black.shape)), 50714: rational(black.ravel(), 1 << 8)}
    else:
        raw |= {50714: rational(np.resize(black, 3), 1 << 8)}
    for tag, value in ((51009, opcodes2), (51022, opcodes3)):
        if value is not None:
            raw[tag] = (7, value)
    if table is not None:
        raw[50712] = (3, list(table))
    if active is not None:
        raw[50829] = (4, list(active))
    if delta_h is not None:
        raw[50715] = rational(delta_h, 1 << 8, signed=True)
    if delta_v is not None:
        raw[50716] = rational(delta_v, 1 << 8, signed=True)
    exif = {
        33434: rational(exposure_s, 1 << 24),
        33437: rational(aperture),
        34855: (3, [iso]),
        36867: (2, time),
        37386: rational(5.5),
    }
    if subsec:
        exif[37521] = (2, subsec)
    raw |= extra or {}
    strip = mosaic.astype(order + "u2").tobytes()
    return tiff(order, {"main": main, "raw": raw, "exif": exif}, strip)


def mosaic_of(radiance, pattern="RGGB"):
    """[H, W] samples of [H, W, 3] under a colour filter array."""
    height, width = radiance.shape[:2]
    if pattern == "XTRANS":
        cells = np.array([["RGB".index(letter) for letter in row] for row in XTRANS])
    else:
        cells = np.array(PATTERNS[pattern]).reshape(2, 2)
    n = len(cells)
    colour = np.tile(cells, (-(-height // n), -(-width // n)))[:height, :width]
    return np.take_along_axis(radiance, colour[..., None], axis=2)[..., 0]


def codes_of(mosaic, black=((0.0,),), white=65535):
    """uint16 codes of a mosaic of radiance, 1.0 = white, clipped."""
    black = np.atleast_2d(np.asarray(black, float))
    height, width = mosaic.shape
    level = np.tile(black, (-(-height // black.shape[0]), -(-width // black.shape[1])))[:height, :width]
    return np.clip(np.round(level + mosaic * (white - level.max())), 0, white).astype(np.uint16)


@pytest.fixture(scope="session")
def make():
    """The writer's parts."""
    return SimpleNamespace(
        dng=dng,
        tiff=tiff,
        opcode=opcode,
        opcode_list=opcode_list,
        gain_map=gain_map,
        vignette=vignette,
        mosaic_of=mosaic_of,
        codes_of=codes_of,
        patterns=tuple(PATTERNS),
    )
