import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.errors import SourceError
from capture.ply import PointCloud, read_ply, write_ply


def cloud(count=50, kind=np.float32, normals=True, colors=True):
    rng = np.random.default_rng(3)
    return PointCloud(
        rng.normal(size=(count, 3)).astype(kind),
        rng.normal(size=(count, 3)).astype(np.float32) if normals else None,
        (rng.integers(0, 256, (count, 3)) / 255).astype(np.float32) if colors else None,
    )


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("colors", [True, False])
def test_what_is_written_is_read(tmp_path, kind, normals, colors):
    original = cloud(kind=kind, normals=normals, colors=colors)
    write_ply(tmp_path / "a.ply", original)
    again = read_ply(tmp_path / "a.ply")
    assert again.points.dtype == kind
    for name in ("points", "normals", "colors"):
        expected, found = getattr(original, name), getattr(again, name)
        assert (expected is None and found is None) or np.array_equal(expected, found)


HEADER = (
    "ply\nformat {} 1.0\ncomment made by hand\nobj_info x\nelement vertex 2\n"
    "property double x\nproperty short label\n"
    "property float y\nproperty float z\nproperty ushort red\nproperty ushort green\nproperty ushort blue\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_every_form_is_read_past_extra_properties_and_faces(tmp_path, form, newline):
    rows = [(0.5, -3, 1.25, 2.0, 65535, 0, 13107), (-0.5, 4, -1.25, 3.0, 0, 65535, 0)]
    if form == "ascii":
        body = newline.join(" ".join(map(str, row)) for row in rows) + newline + "3 0 1 0" + newline
        data = body.encode()
    else:
        order = "<" if form == "binary_little_endian" else ">"
        data = b"".join(struct.pack(order + "dhffHHH", *row) for row in rows)
        data += struct.pack(order + "B3i", 3, 0, 1, 0)
    (tmp_path / "a.ply").write_bytes(HEADER.format(form).replace("\n", newline).encode() + data)
    found = read_ply(tmp_path / "a.ply")
    assert found.points.tolist() == [[0.5, 1.25, 2.0], [-0.5, -1.25, 3.0]]
    assert found.normals is None
    assert found.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]), abs=1e-6)  # float32


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda b: b[:-1], "cut short"),
        (lambda b: b.replace(b"vertex 50", b"vertex 999999999999"), "cut short"),
        (lambda b: b.replace(b"vertex 50", b"vertex 0"), "no points"),
        (lambda b: b.replace(b"vertex 50", b"vertex -5"), "vertex"),
        (lambda b: b.replace(b"property float x", b"property float w"), "'x'"),
        (lambda b: b.replace(b"property float x", b"property list uchar int x"), "not understood"),
        (lambda b: b.replace(b"property float x", b"property float y"), "not understood"),
        (lambda b: b.replace(b"little", b"middle"), "not understood"),
        (lambda b: b.replace(b"element vertex", b"element camera"), "first element"),
        (lambda b: b.replace(b"end_header", b"the_header"), "header"),
        (lambda b: b[1:], "no PLY"),
        (lambda b: b"", "no PLY"),
        (lambda b: b[:-24] + struct.pack("<f", np.nan) + b[-20:], "not finite"),
    ],
)
def test_a_bad_file_is_refused_with_its_fault(tmp_path, change, word):
    path = tmp_path / "a.ply"
    write_ply(path, cloud(normals=True, colors=False))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(SourceError, match=word):
        read_ply(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(SourceError, match=r"none\.ply"):
        read_ply(tmp_path / "none.ply")


ASCII = (
    b"ply\nformat ascii 1.0\nelement vertex 2\n"
    b"property float x\nproperty float y\nproperty float z\nend_header\n"
    b"1 2 3\n4 5 6\n"
)


@pytest.fixture(scope="module")
def binary(tmp_path_factory):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, cloud(3))
    return path.read_bytes()


@given(data=st.data())
def test_damage_is_read_or_refused(binary, damage, scratch, data):
    path = scratch / "damaged.ply"
    path.write_bytes(data.draw(damage(binary) | damage(ASCII)))
    with contextlib.suppress(SourceError):
        found = read_ply(path)
        assert np.isfinite(found.points).all()
        assert len(found.points) <= 10
