import numpy as np
import pytest

from capture.errors import SourceError
from capture.json_fields import Fields, parse_json, read_json


def fields(**values):
    return Fields(values, "thing.json: part 3", SourceError)


@pytest.mark.parametrize(
    "text", ["NaN", "[Infinity]", '{"a": -Infinity}', "{", "[" * 100_000, "", "\ufffe", "9" * 5000]
)
def test_what_is_no_strict_json_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)


@pytest.mark.parametrize("content", [b"[]", b"3", b"{", b"\xff\xfe\xff", b""])
def test_a_file_without_an_object_is_the_callers_error(tmp_path, content):
    (tmp_path / "thing.json").write_bytes(content)
    with pytest.raises(SourceError, match=r"thing\.json"):
        read_json(tmp_path / "thing.json", SourceError)
    with pytest.raises(SourceError, match="cannot be read"):
        read_json(tmp_path / "none.json", SourceError)


@pytest.mark.parametrize(
    ("read", "value"),
    [
        (lambda f: f.text("a"), 3),
        (lambda f: f.text("a"), "nul\0"),
        (lambda f: f.text("a"), "half \ud800"),
        (lambda f: f.number("a"), "3"),
        (lambda f: f.number("a"), 10**400),
        (lambda f: f.number("a"), float("nan")),
        (lambda f: f.integer("a"), 2.5),
        (lambda f: f.integer("a", low=0), -1),
        (lambda f: f.integer("a", high=9), 10),
        (lambda f: f.array("a", (3,)), [1, 2]),
        (lambda f: f.array("a", (None, 2)), [[1, 2], [3]]),
        (lambda f: f.array("a", (2,)), [1, None]),
        (lambda f: f.array("a", (2,)), {"b": 1}),
        (lambda f: f.array("a", (1,)), [10**400]),
        (lambda f: f.child("a"), [1]),
        (lambda f: list(f.children("a", "frame")), {"b": 1}),
        (lambda f: list(f.children("a", "frame")), [1]),
    ],
)
def test_a_value_of_the_wrong_kind_names_key_and_place(read, value):
    with pytest.raises(SourceError, match=r'thing\.json: part 3.*"a"'):
        read(fields(a=value))
    with pytest.raises(SourceError, match='"a" is missing'):
        read(fields(a=None))


def test_values_of_the_right_kind_are_given():
    f = fields(t="x", n=2, i=3.0, b=True, a=[[1, 2], [3, 4]], e=[], o={"k": 1})
    assert (f.text("t"), f.number("n"), f.integer("i"), f.integer("b")) == ("x", 2.0, 3, 1)
    assert np.array_equal(f.array("a", (2, None)), [[1, 2], [3, 4]])
    assert f.array("e", (None,)).shape == (0,)
    assert f.child("o").integer("k") == 1
    assert [part.place for part in fields(p=[{}, {}]).children("p", "frame")][1].endswith("frame 1")


def test_absent_and_null_give_the_default():
    for f in (fields(), fields(a=None)):
        assert "a" not in f
        assert f.text("a", "d") == "d"
        assert f.number("a", 1.5) == 1.5
        assert f.integer("a", None) is None
        assert f.array("a", (3,), None) is None
        assert f.child("a", None) is None
