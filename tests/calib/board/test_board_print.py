import re
import struct
import zlib

import cv2
import numpy as np
import pytest

from calib.board.charuco import Board
from calib.board.detection import BoardDetector
from calib.board.printing import PAPERS, coverage, lay_out, write_sheet
from calib.errors import BoardError
from capture.images import read_image


def strips_of_pdf(data):
    """[n, 4] rectangles of the drawing, mm, and the size of the page, mm."""
    page = np.array(re.search(rb"/MediaBox \[0 0 (\S+) (\S+)\]", data).groups(), dtype=float) / 72 * 25.4
    content = zlib.decompress(re.search(rb"stream\n(.*)\nendstream", data, re.DOTALL)[1]).decode()
    scale = float(re.match(r"q (\S+) 0 0", content)[1])
    assert scale == pytest.approx(72 / 25.4, rel=1e-6)
    return np.array(re.findall(r"(\S+) (\S+) (\S+) (\S+) re", content), dtype=float), page, content


@pytest.mark.parametrize("board", [Board(), Board((5, 8), 0.02, 0.0151, "DICT_6X6_50", "legacy")])
def test_pdf_and_png_show_the_board_at_its_true_size(tmp_path, board):
    write_sheet(board, tmp_path / "b.pdf")
    write_sheet(board, tmp_path / "b.png", dpi=127)  # 5 pixels a millimetre
    strips, page, content = strips_of_pdf((tmp_path / "b.pdf").read_bytes())
    assert page == pytest.approx(PAPERS["a4"], abs=1e-3)
    assert board.describe() in content
    printed = read_image(tmp_path / "b.png")
    assert printed.shape == (1485, 1050)

    view = BoardDetector(board).look(printed, "b.png")
    assert view.layout in (board.layout, "both")
    assert len(view.ids) == len(board.corners_m)
    found_mm = view.corners_px / 5
    # The detector's own precision on a sharp drawing, 0.1 px = 0.02 mm.
    assert np.ptp(found_mm - board.corners_m[:, :2] * 1e3, axis=0).max() < 0.04

    # The PDF's rectangles cover what the PNG shows black: compared at the middles of the PNG's pixels.
    drawn = np.zeros(printed.shape, bool)
    for x, y, w, h in strips * 5:
        drawn[round(y) : round(y + h), round(x) : round(x + w)] = True
    top, bottom = (found_mm[:, 1].min() - 60) * 5, (found_mm[:, 1].max() + 24) * 5
    rows = slice(max(0, int(top)), int(bottom))  # without the text
    sure = (printed[rows] < 30) | (printed[rows] > 225)
    assert sure.mean() > 0.9
    # A pixel whose middle lies on the edge of a rectangle may go either way.
    assert (drawn[rows] != (printed[rows] < 128))[sure].mean() < 2e-3


def test_black_covers_each_pixel_by_its_exact_share():
    board = Board((3, 3), 0.0251, 0.0137)
    sheet = lay_out(board, "a4")
    covered = coverage(sheet, 3.7)
    assert covered.max() <= 1 + 1e-9
    assert covered.min() >= 0
    # The sum of all shares is the black area.
    assert covered.sum() / 3.7**2 == pytest.approx((sheet.cells[:, 2] * sheet.cells[:, 3]).sum(), rel=1e-9)


def test_a_pdf_has_an_index_that_leads_to_its_objects(tmp_path):
    write_sheet(Board(), tmp_path / "b.pdf", paper="letter")
    data = (tmp_path / "b.pdf").read_bytes()
    start = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", data)[1])
    assert data[start:].startswith(b"xref\n0 7\n")
    offsets = re.findall(rb"(\d{10}) 00000 n ", data[start:])
    assert len(offsets) == 6
    for number, offset in enumerate(offsets, start=1):
        assert data[int(offset) :].startswith(f"{number} 0 obj\n".encode())
    length = int(re.search(rb"/Length (\d+)", data)[1])
    assert len(re.search(rb"stream\n(.*)\nendstream", data, re.DOTALL)[1]) == length


def test_a_png_says_its_resolution(tmp_path):
    write_sheet(Board(), tmp_path / "b.png", dpi=100)
    data = (tmp_path / "b.png").read_bytes()
    at = data.index(b"pHYs")
    assert struct.unpack(">IIB", data[at + 4 : at + 13]) == (3937, 3937, 1)
    assert struct.unpack(">I", data[at + 13 : at + 17])[0] == zlib.crc32(data[at : at + 13])
    assert cv2.imread(str(tmp_path / "b.png"), 0).shape == (1169, 827)


def test_a_wide_board_lies_across():
    assert lay_out(Board((10, 7)), "a4").size_mm == (297.0, 210.0)


@pytest.mark.parametrize(
    ("board", "name", "paper", "dpi", "words"),
    [
        (Board((7, 10), 0.035, 0.02), "b.pdf", "a4", 300, r"squares of 27\.5 mm would"),
        (Board(), "b.pdf", "a9", 300, "a4, a3, letter"),
        (Board(), "b.jpg", "a4", 300, r"\.pdf or a \.png"),
        (Board(), "b.png", "a4", 1e5, "dpi"),
    ],
)
def test_what_cannot_be_printed_is_refused(tmp_path, board, name, paper, dpi, words):
    with pytest.raises(BoardError, match=words):
        write_sheet(board, tmp_path / name, paper, dpi)
    assert not list(tmp_path.iterdir())
