"""A sheet with a ChArUco board at true scale, as PDF or PNG, with its description and a ruler to check it by.

Everything on the sheet is a black rectangle in millimetres from the sheet's top left corner, or a line of
text; PDF keeps the rectangles as they are, PNG gets the exact share of each pixel that they cover.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.board.charuco import Board, marker_dictionary
from calib.errors import BoardError
from capture.atomic import atomic_write
from capture.images import encode_image

Floats = NDArray[np.float64]

#: Paper by name: (width, height) in mm, upright.
PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4), "tabloid": (279.4, 431.8)}
_MARGIN_MM = 5.0  # what printers leave free
_FOOT_MM = 17.0  # for description and ruler
_TEXT_MM = 2.8
_RULER_MM = 100.0
_POINTS_PER_MM = 72 / 25.4
_DPI_RANGE = (50.0, 1200.0)


@dataclass(frozen=True, eq=False)
class Sheet:
    """What is printed.

    Attributes:
        size_mm: (width, height) of the paper as it lies.
        cells: [n, 4] x, y, width, height of black rectangles that do not overlap, mm.
        strips: [m, 4] the same black as few long rectangles that do: without seams in any viewer.
        text: (x, y of its base line, words).
    """

    size_mm: tuple[float, float]
    cells: Floats
    strips: Floats
    text: list[tuple[float, float, str]]


def lay_out(board: Board, paper: str) -> Sheet:
    """The board in the middle of a paper, across where it does not fit upright.

    Raises:
        BoardError: it does not fit, or the paper is unknown.
    """
    if paper not in PAPERS:
        raise BoardError(f"The paper {paper!r} is unknown; there are {', '.join(PAPERS)}.")
    width, height = board.squares[0] * board.square_m * 1e3, board.squares[1] * board.square_m * 1e3
    upright = PAPERS[paper]
    for size in (upright, upright[::-1]):
        if width + 2 * _MARGIN_MM <= size[0] and height + _MARGIN_MM + _FOOT_MM <= size[1]:
            break
    else:
        room = max(
            min((w - 2 * _MARGIN_MM) / board.squares[0], (h - _MARGIN_MM - _FOOT_MM) / board.squares[1])
            for w, h in (upright, upright[::-1])
        )
        raise BoardError(
            f"A board of {width:g} x {height:g} mm does not fit on {paper} with its margins; squares of "
            f"{np.floor(10 * room) / 10:g} mm would, or take another paper ({', '.join(PAPERS)})."
        )
    left = (size[0] - width) / 2
    top = max(_MARGIN_MM, (size[1] - height - _FOOT_MM) / 2)
    cells, strips = _black(board)
    origin = np.array([left, top, 0.0, 0.0])
    foot = top + height + _MARGIN_MM
    ruler, numbers = _ruler(left, foot + 7.0, min(_RULER_MM, 10.0 * np.floor(width / 10)))
    text = [
        (left, foot + 2.0, board.describe()),
        *numbers,
    ]
    return Sheet(
        size, np.concatenate([cells + origin, ruler]), np.concatenate([strips + origin, ruler]), text
    )


def write_sheet(board: Board, path: Path, paper: str = "a4", dpi: float = 300.0) -> None:
    """Writes the sheet of a board as .pdf or .png.

    Raises:
        BoardError: another suffix, a board that does not fit, or an impossible resolution.
    """
    path = Path(path)
    sheet = lay_out(board, paper)
    if path.suffix.lower() == ".pdf":
        atomic_write(path, pdf_of(sheet, board.describe()))
    elif path.suffix.lower() == ".png":
        if not _DPI_RANGE[0] <= dpi <= _DPI_RANGE[1]:
            raise BoardError(f"{dpi:g} dpi is not in {_DPI_RANGE[0]:g}..{_DPI_RANGE[1]:g}.")
        atomic_write(path, png_of(sheet, dpi))
    else:
        raise BoardError(f"{path} would be a {path.suffix or 'nameless'} file; a board is a .pdf or a .png.")


def pdf_of(sheet: Sheet, title: str) -> bytes:
    """The sheet as a PDF of one page (ISO 32000-1; Helvetica is in every viewer)."""
    width, height = (side * _POINTS_PER_MM for side in sheet.size_mm)
    # One unit is a millimetre, y downwards. All rectangles are one path: overlaps and seams do not show.
    drawing = [f"q {_POINTS_PER_MM:.8f} 0 0 {-_POINTS_PER_MM:.8f} 0 {height:.6f} cm"]
    drawing += [f"{x:.5f} {y:.5f} {w:.5f} {h:.5f} re" for x, y, w, h in sheet.strips]
    drawing.append("f Q")
    for x, y, words in sheet.text:
        at = (x * _POINTS_PER_MM, height - y * _POINTS_PER_MM)
        drawing.append(
            f"BT /F1 {_TEXT_MM * _POINTS_PER_MM:.3f} Tf {at[0]:.3f} {at[1]:.3f} Td ({_escaped(words)}) Tj ET"
        )
    content = zlib.compress("\n".join(drawing).encode("ascii"))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} /Filter /FlateDecode >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        f"<< /Title ({_escaped(title)}) >>".encode(),
    ]
    data = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(data))
        data += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    end = (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}trailer\n"
        f"<< /Size {len(objects) + 1} /Root 1 0 R /Info 6 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    )
    return data + end.encode()


def png_of(sheet: Sheet, dpi: float) -> bytes:
    """The sheet as a grey PNG that says how large it is to be printed."""
    scale = dpi / 25.4
    picture = 255.0 * (1.0 - coverage(sheet, scale))
    pixels = np.rint(np.clip(picture, 0, 255)).astype(np.uint8)
    size = _TEXT_MM * scale / 22.0  # OpenCV's simplex capitals are 22 px high at size 1
    for x, y, words in sheet.text:
        at = (round(x * scale), round(y * scale))
        thickness = max(1, round(size * 1.5))
        cv2.putText(pixels, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, 0, thickness, cv2.LINE_AA)
    data = encode_image(pixels, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9])
    per_metre = round(dpi / 0.0254)
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    after_header = 8 + 12 + 13  # signature; length, type and checksum of IHDR; its 13 bytes
    return data[:after_header] + chunk + data[after_header:]


def coverage(sheet: Sheet, pixels_per_mm: float) -> Floats:
    """[H, W] share of each pixel that is black."""
    width, height = (round(side * pixels_per_mm) for side in sheet.size_mm)
    black = np.zeros((height, width))
    for x, y, w, h in sheet.cells * pixels_per_mm:
        rows, columns = slice(int(y), int(np.ceil(y + h))), slice(int(x), int(np.ceil(x + w)))
        down = _overlap(np.arange(rows.start, rows.stop), y, y + h)
        across = _overlap(np.arange(columns.start, columns.stop), x, x + w)
        black[rows, columns] += np.outer(down, across)[: height - rows.start, : width - columns.start]
    return black


def _overlap(pixels: NDArray[np.int_], low: float, high: float) -> Floats:
    """Share of each pixel [n, n + 1) within [low, high)."""
    overlap: Floats = np.clip(np.minimum(pixels + 1, high) - np.maximum(pixels, low), 0.0, 1.0)
    return overlap


def _black(board: Board) -> tuple[Floats, Floats]:
    """Cells and strips of a board, mm from its top left corner."""
    square, marker = board.square_m * 1e3, board.marker_m * 1e3
    rows, columns = np.nonzero(board.black_squares)
    squares = np.stack(
        [columns * square, rows * square, np.full(len(rows), square), np.full(len(rows), square)], axis=1
    )
    cells, strips = [squares], [squares]
    dictionary = marker_dictionary(board.dictionary)
    across = dictionary.markerSize + 2
    cell = marker / across
    gap = (square - marker) / 2
    for number, (row, column) in enumerate(np.argwhere(~board.black_squares)):
        black = dictionary.generateImageMarker(number, across) == 0
        corner = np.array([column * square + gap, row * square + gap, 0.0, 0.0])
        filled = np.argwhere(black) * cell
        cells.append(
            corner
            + np.column_stack(
                [filled[:, 1], filled[:, 0], np.full(len(filled), cell), np.full(len(filled), cell)]
            )
        )
        strips.append(corner + cell * _runs(black))
        strips.append(corner + cell * _runs(black.T)[:, [1, 0, 3, 2]])
    return np.concatenate(cells), np.concatenate(strips)


def _runs(black: NDArray[np.bool_]) -> Floats:
    """[n, 4] x, y, width, height of the horizontal runs of black cells."""
    edges = np.diff(np.pad(black.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    lengths = ends[:, 1] - starts[:, 1]
    return np.column_stack([starts[:, 1], starts[:, 0], lengths, np.ones(len(starts))]).astype(np.float64)


def _ruler(left: float, top: float, length: float) -> tuple[Floats, list[tuple[float, float, str]]]:
    """A line with a tick every 10 mm, and the words beside it."""
    thick = 0.2
    ticks = [
        [
            left + at,
            top - (2.0 if at % 50 == 0 else 1.2) + thick,
            thick,
            (2.0 if at % 50 == 0 else 1.2) - thick,
        ]
        for at in np.arange(0.0, length + 1e-6, 10.0)
    ]
    line = [[left, top + thick, length + thick, thick]]
    words = f"{length:g} mm. Print at 100 %, without fitting to the page, and measure."
    return np.array(line + ticks), [(left, top + 4.0, words)]


def _escaped(text: str) -> str:
    """A PDF string's inside."""
    plain = text.encode("ascii", "replace").decode()
    return plain.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
