"""A portrait with a refinement's decoder renders, is saved and goes into other worlds like any other."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic_scene import looking_at
from safetensors.torch import load_file, save_file

from relight.alignment import Similarity
from relight.errors import PortraitError
from relight.lighting import CapturedLight, FlashLight
from relight.maps import Maps, render_maps, splat_maps
from relight.neural.refined.decoder import RefinedDecoder, pixels_a_unit
from relight.neural.refined.layers import CHANGES
from relight.neural.refined.network import RefinedNetwork
from relight.portrait import FIELDS_FILE, TENSORS_FILE, load_portrait
from relight.render import render_view

CAMERA = looking_at(np.array([0.1, 0.05, 0.45]), np.zeros(3), size=56, flash=1)

CHANGED = ("room_radiance", "mask", "flash_gain")


def decoder_of(solved, *, zero=False, descriptors=2, precision="float32"):
    """A decoder without training: its changes are anything, or nothing, but the same every time."""
    random = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = RefinedNetwork(descriptors, (8, 12, 16)).eval().requires_grad_(False)
    if not zero:
        network.unet.last.weight.normal_(0.0, 0.5, generator=random)
    values = torch.randn(len(solved.points), descriptors, generator=random)
    turn = torch.eye(3, dtype=torch.float64)
    return RefinedDecoder(network, values, pixels_a_unit(solved.points, CAMERA), turn, precision)


@pytest.fixture(scope="module")
def portrait(solved):
    return replace(solved, decoder=decoder_of(solved))


def assert_same(before, after):
    for field in fields(Maps):
        first, second = getattr(before, field.name), getattr(after, field.name)
        if first is None:
            assert second is None
        else:
            np.testing.assert_array_equal(first, second, err_msg=field.name)


def test_a_network_that_has_learned_nothing_gives_the_splats(solved):
    maps = render_maps(replace(solved, decoder=decoder_of(solved, zero=True)), CAMERA)
    splats = splat_maps(solved, CAMERA)
    for field in fields(Maps):
        if field.name not in ("mask", "flash_gain"):
            np.testing.assert_array_equal(getattr(maps, field.name), getattr(splats, field.name))
    assert bool((maps.flash_gain == 1.0).all())
    # A logit holds coverage from a thousandth to a thousandth below full.
    on = splats.mask > 0
    np.testing.assert_allclose(maps.mask[on], splats.mask[on].clamp(1e-3, 0.999), atol=1e-6)
    assert not maps.mask[~on].any()


def test_its_maps_are_finite_and_changed_where_the_subject_is_only(portrait, solved):
    maps, splats = render_maps(portrait, CAMERA), splat_maps(solved, CAMERA)
    off = splats.mask == 0
    for field in fields(Maps):
        values = getattr(maps, field.name)
        if values is None:
            continue
        assert values.shape[:2] == (56, 56)
        assert bool(values.isfinite().all())
        if field.name not in ("point_ids", "flash_gain"):
            assert not values[off].any()
    for name in CHANGED:
        before = 1.0 if name == "flash_gain" else getattr(splats, name)[~off]
        assert float((getattr(maps, name)[~off] - before).abs().mean()) > 1e-4
    for name in ("normals_world", "depth", "points_world", "point_ids", "confidence", "gloss", "shading"):
        np.testing.assert_array_equal(getattr(maps, name), getattr(splats, name))


def test_the_flashs_gain_is_in_the_pictures_of_the_flash(portrait):
    maps, radiances = render_view(portrait, CAMERA, {"captured": CapturedLight(), "flash": FlashLight()})
    _, without = render_view(
        replace(portrait, decoder=Ungained(portrait.decoder)), CAMERA, {"flash": FlashLight()}
    )
    np.testing.assert_allclose(radiances["flash"], maps.flash_gain * without["flash"], atol=1e-6)
    np.testing.assert_allclose(
        radiances["captured"], maps.room_radiance * (maps.mask > 0)[..., None] + radiances["flash"], atol=1e-6
    )


class Ungained:
    """A decoder whose maps have no gain."""

    def __init__(self, decoder):
        self.decoder = decoder

    def decode(self, portrait, camera):
        return replace(self.decoder.decode(portrait, camera), flash_gain=None)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 5), (81, 63), (33, 90)])
def test_pictures_of_any_size_are_decoded(portrait, width, height):
    intrinsics = CAMERA.K.copy()
    intrinsics[:2, 2] = width / 2, height / 2
    maps = render_maps(portrait, replace(CAMERA, width=width, height=height, K=intrinsics))
    for name in CHANGED:
        values = getattr(maps, name)
        assert values.shape[:2] == (height, width)
        assert bool(values.isfinite().all())


def test_a_view_is_the_same_whatever_part_of_the_picture_the_subject_takes(portrait):
    views = []
    for shift in (24, 56):  # apart by what holes are filled over, and the network halves
        intrinsics = CAMERA.K.copy()
        intrinsics[:2, 2] += shift
        maps = render_maps(portrait, replace(CAMERA, width=136, height=144, K=intrinsics))
        views.append([getattr(maps, name)[shift : shift + 56, shift : shift + 56] for name in CHANGED])
    for first, second, name in zip(*views, CHANGED, strict=True):
        # Points lie within their pixels as before but for rounding.
        np.testing.assert_allclose(first, second, atol=1e-3, err_msg=name)


def test_where_no_point_is_there_is_nothing(portrait):
    away = looking_at(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]), size=16)
    maps = render_maps(portrait, away)
    assert not maps.mask.any()
    assert not maps.albedo.any()
    assert bool((maps.flash_gain == 1.0).all())


@pytest.fixture
def decoded(monkeypatch):
    """Widths of the views whose changes were asked for."""
    widths = []
    changes = RefinedDecoder.changes

    def seen(self, maps, camera):
        widths.append(camera.width)
        return changes(self, maps, camera)

    monkeypatch.setattr(RefinedDecoder, "changes", seen)
    return widths


def test_a_much_nearer_view_is_decoded_at_the_size_that_was_fitted(portrait, decoded):
    near = replace(CAMERA.scaled(4.0), cam_from_world=CAMERA.cam_from_world)
    maps = render_maps(portrait, near)
    assert decoded == [56]
    assert maps.albedo.shape == (224, 224, 3)
    assert bool(maps.albedo.isfinite().all() and maps.mask.isfinite().all())
    # The changes are those of the view as it was fitted, spread over more pixels.
    far = render_maps(portrait, CAMERA)
    gain = torch.nn.functional.avg_pool2d(maps.flash_gain.permute(2, 0, 1), 4).permute(1, 2, 0)
    on = torch.nn.functional.avg_pool2d(maps.mask[None], 4)[0] > 0.99
    assert on.sum() > 300
    assert float((gain.log() - far.flash_gain.log())[on].abs().mean()) < 0.02


def test_views_of_about_the_fitted_size_or_smaller_are_decoded_as_they_are(portrait, decoded):
    for factor in (0.5, 1.0, 1.2):
        render_maps(portrait, CAMERA.scaled(factor))
    assert decoded == [28, 56, 67]


def test_a_camera_within_the_subject_gives_finite_maps(portrait):
    maps = render_maps(portrait, looking_at(np.array([0.0, 0.0, 0.02]), np.zeros(3), size=24))
    for name in CHANGED:
        assert bool(getattr(maps, name).isfinite().all())


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_it_comes_back_from_the_disk_bit_by_bit(solved, tmp_path, precision):
    portrait = replace(solved, decoder=decoder_of(solved, precision=precision))
    portrait.save(tmp_path)
    again = load_portrait(tmp_path)
    assert again.decoder.settings() == portrait.decoder.settings()
    for name, values in portrait.decoder.tensors().items():
        np.testing.assert_array_equal(again.decoder.tensors()[name], values)
    assert_same(*(render_maps(each, CAMERA) for each in (again, load_portrait(tmp_path))))
    # The network of before lies in memory in another order, so its sums do.
    before, after = render_maps(portrait, CAMERA), render_maps(again, CAMERA)
    np.testing.assert_allclose(after.albedo, before.albedo, rtol=0.02 if precision == "bfloat16" else 1e-4)
    assert not any(parameter.requires_grad for parameter in again.decoder.network.parameters())


def test_it_goes_to_a_device_and_is_the_same(portrait):
    moved = portrait.to("cpu")
    assert moved.decoder is not portrait.decoder
    assert_same(render_maps(moved, CAMERA), render_maps(moved.to("cpu"), CAMERA))
    for name, values in portrait.decoder.tensors().items():
        np.testing.assert_array_equal(moved.decoder.tensors()[name], values)


def test_without_descriptors_it_works_too(solved, tmp_path):
    replace(solved, decoder=decoder_of(solved, descriptors=0)).save(tmp_path)
    again = load_portrait(tmp_path)
    assert again.decoder.descriptors.shape == (len(solved.points), 0)
    assert bool(render_maps(again, CAMERA).albedo.isfinite().all())


def test_in_another_world_it_looks_the_same(portrait):
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    similarity = Similarity(3.0, turn * np.sign(np.linalg.det(turn)), np.array([0.4, -0.2, 0.1]))
    there = portrait.transformed(similarity)
    camera = similarity.camera(CAMERA)
    assert there.decoder.pixels_a_unit == pytest.approx(portrait.decoder.pixels_a_unit / 3.0)
    before, lit_before = render_view(portrait, CAMERA, {"captured": CapturedLight()})
    after, lit_after = render_view(there, camera, {"captured": CapturedLight()})
    # Rounding moves a point across a pixel's edge here and there, and the network sees it: little changes.
    on = (before.mask > 0.5) & (after.mask > 0.5)
    assert on.sum() > 350
    for first, second in (
        (before.albedo, after.albedo),
        (before.flash_gain, after.flash_gain),
        (lit_before["captured"], lit_after["captured"]),
    ):
        apart = (first - second)[on].abs().amax(dim=-1)
        assert float((apart < 2e-3).float().mean()) > 0.97
    # There and back it is the one that it was.
    turn, move = similarity.rotation.T, similarity.translation
    back = there.transformed(Similarity(1.0 / 3.0, turn, -turn @ move / 3.0))
    np.testing.assert_allclose(back.decoder.turn, torch.eye(3), atol=1e-12)
    assert back.decoder.pixels_a_unit == pytest.approx(portrait.decoder.pixels_a_unit)


def test_a_subset_keeps_the_descriptors_of_its_points(portrait):
    count = len(portrait.points)
    for keep in (torch.arange(count) % 3 == 0, torch.arange(0, count, 3)):
        part = portrait.subset(keep)
        np.testing.assert_array_equal(part.decoder.descriptors, portrait.decoder.descriptors[keep])
        assert bool(render_maps(part, CAMERA).albedo.isfinite().all())


def test_making_a_decoder_again_takes_nothing_from_chance(portrait):
    before = torch.random.get_rng_state()
    RefinedDecoder.restored(portrait.decoder.settings(), portrait.decoder.tensors())
    np.testing.assert_array_equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("turn", [[1.0]]),
        ("turn", [[1e999] * 3] * 3),
        ("turn", "north"),
        ("turn", [[1.0, 0.0], [0.0]]),
        ("precision", "half"),
        ("precision", ["float32"]),
        ("pixels_a_unit", 0.0),
        ("pixels_a_unit", -1.0),
        ("pixels_a_unit", "many"),
        ("pixels_a_unit", None),
        ("descriptors", 3),
        ("descriptors", -1),
        ("descriptors", "two"),
        ("widths", []),
        ("widths", None),
        ("widths", [8, 12]),
        ("widths", [-8, 12, 16]),
        ("widths", [0, 12, 16]),
        ("widths", [8, 12, 1_000_000_000]),
        ("widths", ["wide", 12, 16]),
        ("widths", 8),
    ],
)
def test_settings_that_are_not_a_decoders_are_refused(portrait, tmp_path, name, value):
    portrait.save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    content["decoder"]["settings"][name] = value
    (tmp_path / FIELDS_FILE).write_text(json.dumps(content).replace("Infinity", "1e999"))
    with pytest.raises(PortraitError):
        load_portrait(tmp_path)


def test_settings_that_are_missing_are_refused(portrait, tmp_path):
    portrait.save(tmp_path)
    content = json.loads((tmp_path / FIELDS_FILE).read_text())
    for name in content["decoder"]["settings"]:
        fewer = {key: value for key, value in content["decoder"]["settings"].items() if key != name}
        changed = content | {"decoder": content["decoder"] | {"settings": fewer}}
        (tmp_path / FIELDS_FILE).write_text(json.dumps(changed))
        with pytest.raises(PortraitError, match=name):
            load_portrait(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda values: None,
        lambda values: values[:, :-1].clone(),
        lambda values: values.flatten(),
        lambda values: values.double(),
        lambda values: values * torch.nan,
    ],
    ids=["missing", "narrower", "flat", "double", "nan"],
)
@pytest.mark.parametrize("name", ["decoder.network.unet.last.weight", "decoder.descriptors"])
def test_tensors_that_are_not_a_decoders_are_refused(portrait, tmp_path, name, change):
    portrait.save(tmp_path)
    whole = load_file(tmp_path / TENSORS_FILE)
    value = change(whole.pop(name))
    save_file(whole if value is None else whole | {name: value}, tmp_path / TENSORS_FILE)
    with pytest.raises(PortraitError):
        load_portrait(tmp_path)


def test_a_layer_too_many_is_refused(portrait):
    settings, tensors = portrait.decoder.settings(), portrait.decoder.tensors()
    with pytest.raises(ValueError, match="other layers"):
        RefinedDecoder.restored(settings, tensors | {"network.unet.more": torch.zeros(CHANGES)})
