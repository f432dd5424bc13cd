"""Portraits come back as they were saved, and every other file is refused in one sentence."""

import json
import warnings
from dataclasses import fields

import numpy as np
import pytest
import torch
from analytic_scene import PORTRAIT_TENSORS, portrait_of
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from relight.errors import PortraitError
from relight.portrait import FIELDS_FILE, TENSORS_FILE, VERSION, Portrait, load_portrait
from relight.reflectance import Reflectance


def some_portrait(count=7):
    random = torch.Generator().manual_seed(0)
    values = {
        name: torch.rand(count, width, generator=random) if width else torch.rand(count, generator=random)
        for name, width in PORTRAIT_TENSORS.items()
    }
    return portrait_of(
        values.pop("points"),
        values.pop("normals_world"),
        0.00123,
        c_room=(0.1, 0.2, 0.3),
        c_flash=(1 / 3, 0.2, 0.1),
        flash_offset_cam_m=(0.015, -0.01, 0.0),
        reflectance=Reflectance(0.25, 0.35, 0.04),
        info={"solver": "photometric", "frames": 36, "text": "Grüße"},
        **values,
    )


@pytest.fixture
def saved(tmp_path):
    some_portrait().save(tmp_path / "portrait")
    return tmp_path / "portrait"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scratch")
    some_portrait().save(folder)
    return folder


def change(folder, **entries):
    """Rewrites entries of portrait.json; Python writes NaN and Infinity as no JSON should be."""
    content = json.loads((folder / FIELDS_FILE).read_text())
    (folder / FIELDS_FILE).write_text(json.dumps(content | entries))


def refused(folder):
    """The sentence with which a portrait is refused."""
    with pytest.raises(PortraitError) as caught:
        load_portrait(folder)
    message = str(caught.value)
    assert str(folder) in message
    assert message.endswith(".")
    return message


def test_a_portrait_comes_back_as_it_was_saved(saved):
    before, after = some_portrait(), load_portrait(saved)
    for field in fields(Portrait):
        if field.name in PORTRAIT_TENSORS:
            np.testing.assert_array_equal(getattr(after, field.name), getattr(before, field.name))
            assert getattr(after, field.name).dtype == torch.float32
        else:
            assert getattr(after, field.name) == getattr(before, field.name)


def test_saving_again_replaces_the_portrait_and_leaves_no_other_file(saved):
    some_portrait(3).save(saved)
    assert len(load_portrait(saved).points) == 3
    assert sorted(path.name for path in saved.iterdir()) == [FIELDS_FILE, TENSORS_FILE]


def test_a_portrait_that_cannot_be_written_leaves_the_old_one(saved):
    before = [(saved / file).read_bytes() for file in (FIELDS_FILE, TENSORS_FILE)]
    with pytest.raises(ValueError, match="JSON compliant"):
        portrait_of(np.zeros((2, 3)), np.zeros((2, 3)), 1.0, info={"bad": float("nan")}).save(saved)
    assert [(saved / file).read_bytes() for file in (FIELDS_FILE, TENSORS_FILE)] == before


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_portrait_that_could_not_be_read_again_is_not_written(saved, value):
    before = [(saved / file).read_bytes() for file in (FIELDS_FILE, TENSORS_FILE)]
    albedo = np.full((2, 3), 0.5)
    albedo[1, 2] = value
    with pytest.raises(PortraitError, match="1 of the 6 values of its albedo are not finite"):
        portrait_of(np.zeros((2, 3)), np.zeros((2, 3)), 1.0, albedo=albedo).save(saved)
    assert [(saved / file).read_bytes() for file in (FIELDS_FILE, TENSORS_FILE)] == before


def test_a_subset_has_the_chosen_points():
    portrait = some_portrait()
    keep = torch.arange(7) % 2 == 0
    for part in (portrait.subset(keep), portrait.subset(keep.nonzero()[:, 0])):
        for name in PORTRAIT_TENSORS:
            np.testing.assert_array_equal(getattr(part, name), getattr(portrait, name)[keep])
        assert part.c_flash == portrait.c_flash


@pytest.mark.parametrize("file", [FIELDS_FILE, TENSORS_FILE])
def test_a_missing_file_says_what_to_do(saved, file):
    (saved / file).unlink()
    assert "run `relight fit` first" in refused(saved)


@pytest.mark.parametrize("version", [VERSION + 1, 0, "1", None])
def test_another_version_is_refused(saved, version):
    change(saved, version=version)
    assert f"version {version}, this program reads version {VERSION}" in refused(saved)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", "null", '{"schema": "other", "version": 1}', "[" * 10**5]
)
def test_a_file_that_is_no_portrait_is_refused(saved, text):
    (saved / FIELDS_FILE).write_text(text)
    assert "cannot be read" in refused(saved)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("points", 8),
        ("points", -1),
        ("points", 1e999),
        ("points", None),
        ("spacing", float("nan")),
        ("spacing", 0.0),
        ("spacing", -1.0),
        ("spacing", "wide"),
        ("c_room", [1, 2]),
        ("c_flash", [1, 2, float("inf")]),
        ("flash_offset_cam_m", None),
        ("reflectance", {"retro": 0.0, "alpha": 0.25}),
        ("reflectance", {"retro": 0.0, "alpha": 0.0, "f0": 0.0}),
        ("reflectance", {"retro": "a", "alpha": 0.25, "f0": 0.0}),
        ("reflectance", {"retro": 0.0, "alpha": 0.25, "f0": -0.1}),
        ("reflectance", {"retro": 0.0, "alpha": 0.25, "f0": 0.0, "colour": 1}),
        ("reflectance", [0.0, 0.25, 0.0]),
        ("info", "none"),
    ],
)
def test_an_impossible_entry_is_refused(saved, key, value):
    change(saved, **{key: value})
    refused(saved)


def test_a_missing_entry_is_refused(saved):
    content = json.loads((saved / FIELDS_FILE).read_text())
    for key in content.keys() - {"room_gloss"}:  # the first portraits of this version have none
        (saved / FIELDS_FILE).write_text(json.dumps({k: v for k, v in content.items() if k != key}))
        refused(saved)


@pytest.mark.parametrize("name", PORTRAIT_TENSORS)
def test_tensors_that_are_missing_not_finite_or_of_another_form_are_refused(saved, name):
    whole = load_file(saved / TENSORS_FILE)
    nan = whole[name].clone()
    nan[-1] = torch.nan
    for other in (None, nan, whole[name][:-1].clone(), whole[name].double(), whole[name][..., None].clone()):
        tensors = {key: value for key, value in whole.items() if key != name}
        save_file(tensors if other is None else tensors | {name: other}, saved / TENSORS_FILE)
        assert name in refused(saved)


def test_a_portrait_without_points_is_refused(tmp_path):
    portrait_of(np.zeros((0, 3)), np.zeros((0, 3)), 1.0).save(tmp_path)
    assert "no points" in refused(tmp_path)


@pytest.mark.parametrize("file", [FIELDS_FILE, TENSORS_FILE])
@given(data=st.data())
def test_damage_is_refused_or_leaves_a_finite_portrait(file, data, scratch):
    content = (scratch / file).read_bytes()
    at = data.draw(st.integers(0, len(content)))
    scrap = data.draw(
        st.sampled_from([b"", b"NaN", b"-1", b"1e999", b"null", b"[]", b"\xff" * 8, b"\0" * 8, b"9" * 400])
    )
    cut, keep = data.draw(st.booleans()), data.draw(st.integers(0, 12))
    damaged = content[:at] + scrap + (b"" if cut else content[at + keep :])
    try:
        (scratch / file).write_bytes(damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            portrait = load_portrait(scratch)
    except PortraitError:
        pass
    else:  # such as another digit, or another word in `info`
        assert all(getattr(portrait, name).isfinite().all() for name in PORTRAIT_TENSORS)
        assert np.isfinite([portrait.spacing, *portrait.c_room, *portrait.c_flash]).all()
    finally:
        (scratch / file).write_bytes(content)
