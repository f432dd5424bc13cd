import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.errors import SourceError
from capture.importers.flash_list import read_flash_list

NAMES = ["left/0007.jpg", "left/0008.jpg", "right/0008.jpg", "right/0000.png", "1.jpg"]


@pytest.mark.parametrize(
    ("name", "text", "flags"),
    [
        ("a.txt", "0007.jpg\n1.jpg\n", [1, 0, 0, 0, 1]),
        ("a.txt", "# lit\n./left/0008.jpg  # second\n\n0000\n", [0, 1, 0, 1, 0]),
        ("a.txt", "0\n2\n", [1, 0, 1, 0, 0]),
        ("a.txt", "1\n", [0, 0, 0, 0, 1]),  # the stem of 1.jpg goes before the number
        ("a.csv", "name,flash\r\n0007.jpg,1\r\nright/0008.jpg,0\r\n", [1, None, 0, None, None]),
        ("a.csv", '"0007.jpg", 1\n', [1, None, None, None, None]),
        ("a.txt", "right\\0008.jpg\n", [0, 0, 1, 0, 0]),
        ("a.json", '["0007.jpg", 2]', [1, 0, 1, 0, 0]),
        ("a.json", '{"0007": 1, "0000": false}', [1, None, None, 0, None]),
    ],
)
def test_every_form_is_read(tmp_path, name, text, flags):
    (tmp_path / name).write_text(text)
    assert read_flash_list(tmp_path / name, NAMES) == flags


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "0009.jpg\n", "'0009.jpg', which no frames"),
        ("a.txt", "0008.jpg\n", "'0008.jpg', which 2 frames"),
        ("a.txt", "0007\nleft/0007.jpg\n", "twice"),
        ("a.txt", "0007\n0000,1\n", "with and without"),
        ("a.txt", "0007,1\n0000,2\n", "line 2"),
        ("a.txt", "# nothing\n", "empty"),
        ("a.txt", "9\n", "no frames"),
        ("a.json", "{", "JSON"),
        ("a.json", '{"0007": 2}', "list of frames"),
        ("a.json", "[[1]]", "list of frames"),
        ("a.json", "[]", "empty"),
        ("a.txt", None, "cannot be read"),
    ],
)
def test_what_is_unclear_is_refused(tmp_path, name, text, words):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=words):
        read_flash_list(tmp_path / name, NAMES)


@given(data=st.data(), suffix=st.sampled_from([".txt", ".json"]))
def test_damage_is_read_or_refused(damage, scratch, data, suffix):
    path = scratch / f"flash{suffix}"
    path.write_bytes(
        data.draw(damage(b'["0007.jpg", 2]' if suffix == ".json" else b"name,flash\n0007.jpg,1\n1.jpg,0\n"))
    )
    with contextlib.suppress(SourceError):
        assert len(read_flash_list(path, NAMES)) == len(NAMES)
