import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.frame_record import EXCLUDING_REASONS, FrameRecord

TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)


def record(**changes):
    return FrameRecord(**({"index": 3, "file": "frames/000003.png", "width": 64, "height": 48} | changes))


UNIT = st.none() | st.floats(0, 1)


@given(
    index=st.integers(0, 10**9),
    pts_s=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    sequence=st.none() | st.integers(),
    flash=st.sampled_from([None, 0, 1]),
    lit_fraction=UNIT,
    confidence=UNIT,
    reasons=st.lists(TEXT, max_size=3),
    split=st.sampled_from([None, "train", "val"]),
    source=st.none() | TEXT,
)
def test_a_line_gives_its_record_back(**values):
    original = record(**values)
    line = original.to_json()
    assert "\n" not in line
    assert FrameRecord.from_json(line.encode()) == original


def test_unknown_values_are_left_out_but_file_and_flash_are_said():
    assert json.loads(record(file=None).to_json()) == {
        "index": 3,
        "file": None,
        "width": 64,
        "height": 48,
        "flash": None,
    }


def test_numpy_scalars_become_plain_numbers():
    found = record(index=np.int64(3), pts_s=np.float32(0.5), flash=True, reasons=["drift"])
    assert found == record(pts_s=0.5, flash=1, reasons=("drift",))
    assert '"flash": 1' in found.to_json()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"index": -1}, "index"),
        ({"index": 1.5}, "index"),
        ({"index": None}, "index"),
        ({"index": 10**10}, "index"),
        ({"width": 0}, "width"),
        ({"height": "48"}, "height"),
        ({"flash": 2}, "flash"),
        ({"pts_s": float("nan")}, "pts_s is nan"),
        ({"gain": np.inf}, "gain is inf"),
        ({"exposure_s": "1/100"}, "exposure_s"),
        ({"split": "test"}, "split"),
        ({"reasons": "drift"}, "reasons"),
        ({"reasons": [1]}, "reasons"),
        ({"file": "/etc/passwd"}, "file"),
        ({"file": "../a.png"}, "file"),
        ({"file": "a\\b.png"}, "file"),
        ({"file": ""}, "file"),
        ({"file": "a\0.png"}, "file"),
        ({"source": "half \ud800"}, "source"),
        ({"reasons": ["nul\0"]}, "reasons"),
    ],
)
def test_an_impossible_value_is_named(changes, words):
    with pytest.raises(ValueError, match=words):
        record(**changes)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"index": 1, "file": null, "width": 1}', "height is missing"),
        ('{"index": 1, "file": null, "width": 1, "height": 1, "colour": 2}', "'colour' is unknown"),
        ("[1]", "no JSON object"),
        ("{", "Expecting"),
        ('{"index": NaN, "file": null, "width": 1, "height": 1}', "NaN"),
    ],
)
def test_a_malformed_line_is_a_value_error(line, words):
    with pytest.raises(ValueError, match=words):
        FrameRecord.from_json(line)


def test_usable_frames_are_kept_tagged_and_not_excluded():
    assert record(flash=1).usable
    assert record(flash=0, reasons=("dropped_before",)).usable
    assert not record(flash=None).usable
    assert not record(flash=1, file=None).usable
    assert not any(record(flash=1, reasons=(reason,)).usable for reason in EXCLUDING_REASONS)
