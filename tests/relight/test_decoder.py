"""A portrait's decoder makes its maps, goes where it goes, and comes back from the disk with it."""

import json

import numpy as np
import pytest
import torch
from analytic_scene import looking_at, sphere_portrait
from plain_decoder import PlainDecoder
from safetensors.torch import load_file, save_file

from relight.alignment import Similarity
from relight.decoder import KINDS, restored_decoder
from relight.errors import PortraitError
from relight.maps import render_maps, splat_maps
from relight.portrait import FIELDS_FILE, TENSORS_FILE, load_portrait

CAMERA = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), size=24)


@pytest.fixture(autouse=True)
def plain_kind(monkeypatch):
    monkeypatch.setitem(KINDS, "plain", "plain_decoder:PlainDecoder")


def decoded(count=500):
    """A sphere whose decoder halves the albedo."""
    return sphere_portrait(count, decoder=PlainDecoder(0.5, torch.ones(count)))


def test_a_decoder_makes_the_maps_of_its_portrait():
    plain, own = splat_maps(decoded(), CAMERA), render_maps(decoded(), CAMERA)
    np.testing.assert_array_equal(own.albedo, 0.5 * plain.albedo)
    np.testing.assert_array_equal(own.mask, plain.mask)


def test_without_a_decoder_the_points_are_splatted():
    plain, own = splat_maps(sphere_portrait(500), CAMERA), render_maps(sphere_portrait(500), CAMERA)
    for name, values in vars(plain).items():
        np.testing.assert_array_equal(getattr(own, name), values)


def test_a_decoder_comes_back_as_it_was_saved(tmp_path):
    portrait = decoded()
    portrait.decoder.dark[3] = 0.25
    portrait.save(tmp_path)
    decoder = load_portrait(tmp_path).decoder
    assert isinstance(decoder, PlainDecoder)
    assert decoder.factor == 0.5
    np.testing.assert_array_equal(decoder.dark, portrait.decoder.dark)


def test_a_portrait_of_version_1_is_read_and_has_no_decoder(tmp_path):
    sphere_portrait(50).save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    assert content.pop("decoder") is None
    (tmp_path / FIELDS_FILE).write_text(json.dumps(content | {"version": 1}))
    assert load_portrait(tmp_path).decoder is None


def test_a_portrait_of_version_2_is_read_and_knows_no_bounce_under_the_flash(tmp_path):
    decoded(50).save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    del content["bounce_scale"]
    tensors = load_file(tmp_path / TENSORS_FILE)
    del tensors["flash_bounce"]
    save_file(tensors, tmp_path / TENSORS_FILE)
    (tmp_path / FIELDS_FILE).write_text(json.dumps(content | {"version": 2}))
    old = load_portrait(tmp_path)
    assert old.decoder is not None
    assert old.bounce_scale == 1.0
    assert not old.flash_bounce.any()


def test_a_decoder_is_subset_moved_and_transformed_with_its_portrait():
    portrait = decoded(10)
    keep = torch.arange(10) < 4
    assert len(portrait.subset(keep).decoder.dark) == 4
    assert portrait.to("cpu").decoder.factor == 0.5
    moved = portrait.transformed(Similarity(2.0, np.eye(3), np.zeros(3)))
    assert moved.decoder.factor == 0.5


def test_an_unknown_kind_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(PortraitError, match="'magic' is none of those known"):
        restored_decoder("magic", {}, {})
    decoded().save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    for kind in ("magic", 7, None, ["plain"], {}):
        content["decoder"]["kind"] = kind
        (tmp_path / FIELDS_FILE).write_text(json.dumps(content))
        with pytest.raises(PortraitError, match="none of those known"):
            load_portrait(tmp_path)


@pytest.mark.parametrize(
    "entry",
    [
        7,
        {"kind": "plain"},
        {"settings": {"factor": 1.0}},
        {"kind": "plain", "settings": {}},
        {"kind": "plain", "settings": {"factor": "much"}},
        {"kind": "plain", "settings": [1]},
    ],
)
def test_malformed_settings_are_refused(tmp_path, entry):
    decoded().save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    (tmp_path / FIELDS_FILE).write_text(json.dumps(content | {"decoder": entry}))
    with pytest.raises(PortraitError, match="damaged"):
        load_portrait(tmp_path)


def test_missing_malformed_and_infinite_tensors_are_refused(tmp_path):
    decoded().save(tmp_path)
    whole = load_file(tmp_path / TENSORS_FILE)
    for other in (None, whole["decoder.dark"][:, None], whole["decoder.dark"] * torch.inf):
        tensors = {name: values for name, values in whole.items() if name != "decoder.dark"}
        save_file(
            tensors if other is None else tensors | {"decoder.dark": other.contiguous()},
            tmp_path / TENSORS_FILE,
        )
        with pytest.raises(PortraitError, match="damaged"):
            load_portrait(tmp_path)
