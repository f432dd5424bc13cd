import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.lens.yaml_subset import parse_yaml

OPENCV = """%YAML:1.0
---
calibration_time: "Sun 22 Nov 2026 10:00:00"
image_width: 640   # pixels
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.5e+02, 0., 3.2e+02, 0.,
       5.6e+02, 2.4e+02, 0., 0., 1. ]
flags: 0
"""


def test_opencv_files_are_read():
    content = parse_yaml(OPENCV)
    assert content["calibration_time"] == "Sun 22 Nov 2026 10:00:00"
    assert content["image_width"] == 640
    assert content["camera_matrix"]["data"] == [550, 0, 320, 0, 560, 240, 0, 0, 1]
    assert content["camera_matrix"]["dt"] == "d"
    assert content["flags"] == 0


def test_lists_of_lines_and_nested_lists_are_read():
    content = parse_yaml(
        "cam0:\n  T:\n  - [1.0, 2.0]\n  - [3, [4, x]]\n  names: [a, 'b, c']\nlast:\n- k: 1\n  m: 2\n"
    )
    assert content == {
        "cam0": {"T": [[1, 2], [3, [4, "x"]]], "names": ["a", "b, c"]},
        "last": [{"k": 1, "m": 2}],
    }


def test_an_empty_text_is_an_empty_mapping():
    assert parse_yaml("") == {} == parse_yaml("%YAML:1.0\n---\n# nothing\n")
    assert parse_yaml("a:\nb: []\n") == {"a": "", "b": []}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("just words", "line 1 is no 'name: value'"),
        ("a: 1\na: 2", "'a' appears twice"),
        ("a: [1, 2", "not closed"),
        ("a: [1]]", "line 1"),
        ("a: 1\n   b: 2", "line 2"),
        ("a:\n  - ", "empty item"),
        ("a: " + "[" * 30 + "]" * 30, "nested too deeply"),
        ("\n".join("  " * n + "a:" for n in range(40)), "nested too deeply"),
        ("a: " + "x" * (1 << 20), "larger than"),
        ("a: [1] 2", "line 1"),
    ],
)
def test_what_is_not_understood_is_refused_by_line(text, words):
    with pytest.raises(ValueError, match=words):
        parse_yaml(text)


@given(st.text("äab:-[]{},#\"' \n\t!%.1e", max_size=80))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(ValueError):
        parse_yaml(text)


@given(data=st.data())
def test_damage_is_read_or_refused(data):
    at = data.draw(st.integers(0, len(OPENCV)))
    scrap = data.draw(st.text("[]:-\n ,\"'", max_size=4))
    with contextlib.suppress(ValueError):
        parse_yaml(OPENCV[:at] + scrap + OPENCV[at + data.draw(st.integers(0, 5)) :])
