"""Stills lit and unlit in any order, seen by a hand that moves round a head in a room that drifts."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.errors import TaggingError
from capture.images import read_image
from capture.sim import Rig, RigConfig
from capture.sim.camera_path import CameraPath
from capture.tagging import ProfileAccumulator
from capture.tagging.stills import tag_stills
from capture.transfer import to_display

PORTRAIT_A = Path(os.environ.get("RELIGHT_PORTRAIT_A", Path(__file__).parents[3] / "../shared/portrait_A"))
COUNT = 60
PATTERNS = {
    "every fifth": np.arange(COUNT) % 5 == 0,
    "in turn": np.arange(COUNT) % 2 == 0,
    "in pairs": np.arange(COUNT) // 2 % 2 == 0,
    "six by six": np.arange(COUNT) // 6 % 2 == 0,
    "any third": np.random.default_rng(1).random(COUNT) < 0.3,
    "any half": np.random.default_rng(2).random(COUNT) < 0.5,
    "three in all": np.isin(np.arange(COUNT), (10, 31, 50)),
}


@pytest.fixture(scope="module")
def layers():
    """[K, H, W] luminance of the room's light and of the flash, of stills on the rig's half circle."""
    config = RigConfig.small()
    rig = Rig.build(replace(config, path=CameraPath(), supersampling=1))
    times_s = (np.arange(COUNT) + 0.5) / COUNT * rig.config.path.duration_s
    views = [rig.layers(rig.camera(time_s, "x"), True) for time_s in times_s]
    weights = np.array([0.2126, 0.7152, 0.0722])
    return np.array([view.room @ weights for view in views]), np.array(
        [view.flash @ weights for view in views if view.flash is not None]
    )


def profiles(radiance):
    height, width = radiance.shape[1:]
    accumulator = ProfileAccumulator(width, height, transfer="srgb")
    for index, picture in enumerate(radiance):
        code = np.round(255 * to_display(np.clip(picture, 0, 1).astype(np.float32), "srgb"))
        accumulator.add(code.astype(np.uint8), float(index))
    return accumulator.profiles()


def tagged(layers, lit, strength=1.0, exposure=1.0):
    room, flash = layers
    lit = np.asarray(lit, float).reshape(-1, 1, 1)
    exposure = np.broadcast_to(exposure, len(room)).reshape(-1, 1, 1)
    return tag_stills(profiles((room + strength * lit * flash) * exposure))


def wrong_and_unknown(result, lit):
    flags = [tag.flash for tag in result.frames]
    wrong = [k for k, flag in enumerate(flags) if flag is not None and flag != lit[k]]
    return wrong, sum(flag is None for flag in flags)


# The rig's flash adds 0.9 of the room's light on the head: a tenth of that light, as much, and nine times.
@pytest.mark.parametrize(
    ("name", "strength"),
    [
        *((name, 0.12) for name in PATTERNS),
        *((name, 1.0) for name in PATTERNS),
        ("every fifth", 10.0),
        ("in turn", 10.0),
    ],
)
def test_no_order_of_lit_and_unlit_pictures_is_mistaken(layers, name, strength):
    wrong, unknown = wrong_and_unknown(tagged(layers, PATTERNS[name], strength), PATTERNS[name])
    assert wrong == []
    assert unknown <= COUNT / (10 if strength > 0.5 else 5)  # in doubt none is labelled; few are in doubt


@pytest.mark.parametrize("name", ["every fifth", "any half"])
def test_exposure_may_drift(layers, name):
    exposure = 1 + 0.2 * np.linspace(-1, 1, COUNT)
    wrong, unknown = wrong_and_unknown(tagged(layers, PATTERNS[name], exposure=exposure), PATTERNS[name])
    assert wrong == []
    assert unknown <= COUNT / 10


@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_an_exposure_that_jumps_from_picture_to_picture_leads_to_no_wrong_label(layers, strength):
    exposure = np.random.default_rng(3).uniform(0.8, 1.2, COUNT)
    for name in ("every fifth", "any half"):
        try:
            result = tagged(layers, PATTERNS[name], strength, exposure)
        except TaggingError:
            continue
        assert wrong_and_unknown(result, PATTERNS[name])[0] == []


@pytest.mark.parametrize("lit", [0, 1])
@pytest.mark.parametrize("exposure", ["steady", "drifting", "jumping", "a step"])
def test_all_lit_or_none_is_refused_with_what_to_do(layers, lit, exposure):
    gains = {
        "steady": np.ones(COUNT),
        "drifting": np.linspace(0.8, 1.2, COUNT),
        "jumping": np.random.default_rng(4).uniform(0.8, 1.2, COUNT),
        "a step": np.where(np.arange(COUNT) < 30, 1.0, 1.6),
    }
    with pytest.raises(TaggingError, match="flash list") as refusal:
        tagged(layers, np.full(COUNT, lit), exposure=gains[exposure])
    assert str(refusal.value).endswith(".")


def test_a_room_lamp_that_is_switched_on_and_off_again_is_no_flash(layers):
    exposure = np.where((np.arange(COUNT) > 15) & (np.arange(COUNT) < 40), 1.5, 1.0)
    with pytest.raises(TaggingError):
        tagged(layers, np.zeros(COUNT), exposure=exposure)


def test_pictures_that_are_lit_in_part_are_left_unknown(layers):
    room, flash = layers
    lit = PATTERNS["every fifth"].astype(float)
    rows = np.broadcast_to(lit[:, None, None], room.shape).copy()
    height = room.shape[1]
    rows[10, height // 2 :] = 0.0  # the pulse ended while the rows were read
    rows[25, : height // 3] = 0.0
    rows[40] = 0.5  # or was too short for the exposure
    result = tag_stills(profiles(room + rows * flash))
    assert [result.frames[k].flash for k in (10, 25, 40)] == [None] * 3
    assert result.frames[40].reasons == ("partial_flash",)
    others = np.delete(np.arange(COUNT), (10, 25, 40))
    assert [result.frames[k].flash for k in others] == lit[others].astype(int).tolist()
    assert len(result.warnings) == 1


def test_black_and_few_pictures_are_said(layers):
    room, flash = layers
    lit = PATTERNS["every fifth"]
    pictures = room + lit[:, None, None] * flash
    pictures[7] = 0.0
    result = tag_stills(profiles(pictures))
    assert (result.frames[7].flash, result.frames[7].reasons) == (None, ("unreadable",))
    wrong, unknown = wrong_and_unknown(result, lit)
    assert wrong == []
    assert unknown <= 3  # the black one, and the two beside the gap at most
    for count in (0, 1, 7):
        with pytest.raises(TaggingError, match="at least 8"):
            tag_stills(profiles(pictures[:count]))
    with pytest.raises(TaggingError):
        tag_stills(profiles(np.full((20, 96, 160), 0.3)))


@pytest.mark.skipif(not PORTRAIT_A.is_dir(), reason=f"the measured portrait is not at {PORTRAIT_A}")
def test_the_measured_portrait_is_tagged_with_and_without_its_gaps():
    frames = json.loads((PORTRAIT_A / "cameras.json").read_text())["frames"]
    accumulators = [ProfileAccumulator(512, 512, transfer="srgb") for _ in range(2)]
    for frame in frames:
        picture = read_image(PORTRAIT_A / frame["file"])
        accumulators[0].add(picture, float(frame["index"]))
        if frame["split"] == "train":
            accumulators[1].add(picture, float(frame["index"]))
    lit = [bool(frame["flash"]) for frame in frames]
    trained = [bool(frame["flash"]) for frame in frames if frame["split"] == "train"]
    for accumulator, truth in zip(accumulators, (lit, trained), strict=True):
        assert wrong_and_unknown(tag_stills(accumulator.profiles()), truth) == ([], 0)
