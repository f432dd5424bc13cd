"""Lights from text and from lights.json; every complaint lists what is known."""

import contextlib
import json
import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from capture.errors import RelightError
from capture.images import write_exr
from relight.errors import LightError
from relight.light_spec import load_lights, name_of_spec, parse_light, parse_lights
from relight.lighting import (
    CapturedLight,
    DirectionalLight,
    EnvironmentLight,
    FlashLight,
    PointLight,
    RoomLight,
    SphericalHarmonicsLight,
    SumLight,
)
from relight.spherical_harmonics import rotate_sh, rotation_about_up

COEFFICIENTS = (np.arange(27).reshape(9, 3) / 10.0).tolist()


@pytest.fixture
def folder(tmp_path):
    write_exr(tmp_path / "studio.exr", np.ones((4, 8, 3)))
    (tmp_path / "coefficients.json").write_text(json.dumps({"coefficients": COEFFICIENTS}))
    return tmp_path


def write_lights(folder, *entries):
    path = folder / "lights.json"
    path.write_text(json.dumps({"lights": list(entries)}))
    return path


def test_lights_of_the_capture_need_no_values():
    assert parse_light("captured") == ("captured", CapturedLight())
    assert parse_light("room") == ("room", RoomLight())
    assert parse_light("flash") == ("flash", FlashLight())
    assert parse_light("room+flash") == ("room+flash", SumLight((RoomLight(), FlashLight())))


def test_directional_light_with_its_options():
    _, light = parse_light("directional:0,0,1;ambient=0.5;color=1,.8,.6;shadows=on")
    assert light == DirectionalLight((0, 0, 1), 0.5, (1, 0.8, 0.6), shadows=True)
    assert parse_light("directional: 0, 0, 1 ; ambient = 0.5")[1] == DirectionalLight((0, 0, 1), 0.5)


def test_room_with_a_lamp_is_the_sum_of_both():
    name, light = parse_light("room+point:-0.5,1e+0,.8;color=1,.8,.6;name=lamp")
    assert name == "lamp"
    assert light == SumLight((RoomLight(), PointLight((-0.5, 1.0, 0.8), (1, 0.8, 0.6))))


def test_strength_of_a_point_light_is_c_color_or_intensity():
    assert parse_light("point:1,2,3;C=1,2,3")[1] == PointLight((1, 2, 3), (1, 2, 3))
    _, light = parse_light("point:1,2,3;intensity=1,2,3;shadows=off")
    assert isinstance(light, PointLight)
    assert pytest.approx([1 / math.pi, 2 / math.pi, 3 / math.pi]) == light.C
    assert not light.shadows
    with pytest.raises(LightError, match='"C" and "color" say the same'):
        parse_light("point:1,2,3;C=1,1,1;color=1,1,1")


def test_lights_with_a_size_cast_soft_shadows():
    assert parse_light("point:1,2,3;radius=0.05")[1] == PointLight((1, 2, 3), radius=0.05)
    _, sun = parse_light("directional:0,0,1;angle=5")
    assert sun == DirectionalLight((0, 0, 1), shadows=True, angle_deg=5.0)
    assert not parse_light("directional:0,0,1;angle=5;shadows=off")[1].shadows
    with pytest.raises(LightError, match="radius is -1"):
        parse_light("point:1,2,3;radius=-1")
    with pytest.raises(LightError, match="angle is 200"):
        parse_light("directional:0,0,1;angle=200")


def test_environment_with_its_options(folder):
    _, light = parse_light("env:studio.exr;rotate=90;gain=2;method=sh;shadows=off", folder)
    assert isinstance(light, EnvironmentLight)
    assert light.panorama.shape == (4, 8, 3)
    assert (light.rotate_deg, light.gain, light.method, light.shadows) == (90.0, 2.0, "sh", False)


def test_spherical_harmonics_from_a_file_rotated_and_scaled(folder):
    _, light = parse_light("sh:coefficients.json", folder)
    assert isinstance(light, SphericalHarmonicsLight)
    # Rotated by nothing, which solves a small least squares problem in double precision.
    torch.testing.assert_close(light.coefficients, torch.tensor(COEFFICIENTS, dtype=torch.float64))
    _, turned = parse_light("sh:coefficients.json;rotate=90;gain=2", folder)
    assert isinstance(turned, SphericalHarmonicsLight)
    expected = 2 * rotate_sh(light.coefficients, rotation_about_up(90))
    torch.testing.assert_close(turned.coefficients, expected)


def test_lights_file_holds_the_same_lights(folder):
    path = write_lights(
        folder,
        {"name": "captured", "kind": "captured"},
        {"name": "dir1", "kind": "directional", "to_light": [0, 0.6, 0.8], "ambient": 0.5},
        {"name": "env1", "kind": "environment", "map": "studio.exr", "shadows": False},
        {"name": "point", "kind": "point", "position": [1, 2, 3], "C": [0.9, 0.8, 0.7]},
        {"name": "soft", "kind": "sh", "coefficients": COEFFICIENTS},
        {
            "name": "both",
            "kind": "sum",
            "parts": [{"kind": "room"}, {"kind": "point", "position": [1, 2, 3]}],
        },
    )
    lights = load_lights(path)
    assert list(lights) == ["captured", "dir1", "env1", "point", "soft", "both"]
    assert lights["dir1"] == DirectionalLight((0, 0.6, 0.8), 0.5)
    assert lights["point"] == PointLight((1, 2, 3), (0.9, 0.8, 0.7))
    assert lights["both"] == SumLight((RoomLight(), PointLight((1, 2, 3))))


def test_unknown_keys_of_a_file_are_ignored_with_a_warning(folder, caplog):
    path = write_lights(
        folder, {"name": "a", "kind": "directional", "to_light": [0, 0, 1], "source": "a tool"}
    )
    assert load_lights(path) == {"a": DirectionalLight((0, 0, 1))}
    assert '"directional" has no "source"' in caplog.text


def test_several_specs_and_files_give_one_set(folder):
    path = write_lights(folder, {"name": "captured", "kind": "captured"}, {"name": "room", "kind": "room"})
    lights = parse_lights([path.name, "flash", "sh:coefficients.json"], folder)
    assert list(lights) == ["captured", "room", "flash", "sh_coefficients_json"]
    with pytest.raises(LightError, match='Two lights are called "room"'):
        parse_lights(["room", path.name], folder)


def test_names_for_files_are_made_from_the_spec():
    assert name_of_spec("room+point:0.5,-0.2,1;color=1,.8,.6") == "room+point_0_5_-0_2_1_color_1_8_6"
    assert name_of_spec("env:/home/someone/studio.hdr;rotate=90") == "env_studio_hdr_rotate_90"
    assert len(name_of_spec("env:" + "a" * 200)) == 80


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        (
            "lamp:1,2,3",
            'no light "lamp"; known are captured, room, flash, directional, point, environment, sh',
        ),
        ("", 'no light ""'),
        ("room+lamp", 'no light "lamp"'),
        ("room:1", '"room" takes no value'),
        ("directional", r'"directional" needs a value, as in directional:0,0,1;ambient=0\.5'),
        ("directional:0,0,1;ambient", '"ambient" is no option; write key=value'),
        ("directional:0,0,1;ambiant=0.5", 'no "ambiant"; it has to_light, ambient, color, shadows'),
        ("room;ambient=0.5", '"room" has no "ambient"; it has no options'),
        ("directional:0,0,1;ambient=0.5;ambient=1", '"ambient" is given twice'),
        ("directional:0,0,0", "direction of finite length above 0"),
        ("directional:0,0", r'"to_light" has the shape \[2\]; it must be \[3\]'),
        ("directional:a,b,c", '"to_light" must be numbers'),
        ("directional:0,0,nan", "not a finite number"),
        ("directional:0,0,1;ambient=2", r"ambient is 2\.0; it must lie in 0\.\.1"),
        ("point:1,2,3;shadows=maybe", '"shadows" must be a number'),
        ("env:none.exr", r"none\.exr"),
        ("env:studio.exr;method=fast", "exact or sh"),
        ("sh:none.json", r"none\.json cannot be read"),
        ("room;name=albedo", '"albedo" is the name of a map'),
        ("room;name=../../etc/passwd", "is no name for files"),
    ],
)
def test_wrong_specs_say_what_is_wrong_and_what_is_known(folder, spec, complaint):
    with pytest.raises(LightError, match=complaint):
        parse_light(spec, folder)


@pytest.mark.parametrize(
    ("entries", "complaint"),
    [
        ([], "has no lights"),
        ([{"kind": "room"}], '"name" is missing'),
        ([{"name": "a"}], 'light "a": "kind" is missing'),
        ([{"name": "a", "kind": "room"}, {"name": "a", "kind": "flash"}], 'two lights are called "a"'),
        ([{"name": "a/b", "kind": "room"}], "is no name for files"),
        ([{"name": "a", "kind": "point"}], '"position" is missing'),
        ([{"name": "a", "kind": "sum", "parts": []}], "at least one light"),
        ([{"name": "a", "kind": "sum", "parts": [{"kind": "sum", "parts": []}]}], 'no light "sum"'),
        ([{"name": "a", "kind": "sh", "coefficients": [[1, 2, 3]] * 5}], "5 coefficients"),
        ([{"name": "a", "kind": "sh", "coefficients": [[1, 2]]}], r"it must be \[n, 3\]"),
        ([{"name": "a", "kind": "environment", "map": 3}], '"map" must be a text'),
    ],
)
def test_wrong_files_say_which_light_is_wrong(folder, entries, complaint):
    with pytest.raises(LightError, match=complaint):
        load_lights(write_lights(folder, *entries))


def test_missing_and_malformed_files_are_named(folder):
    with pytest.raises(LightError, match=r"none\.json cannot be read"):
        load_lights(folder / "none.json")
    (folder / "broken.json").write_text('{"lights": [')
    with pytest.raises(LightError, match=r"broken\.json is not valid JSON"):
        load_lights(folder / "broken.json")


KINDS = ["captured", "room", "flash", "directional", "point", "env", "sh", "sum", ""]


@given(
    st.lists(
        st.sampled_from([*KINDS, "+", ":", ";", "=", ",", "0,0,1", "1e9", "nan", "ambient", "name", "x.json"])
        | st.text(max_size=4),
        max_size=8,
    ).map("".join)
)
def test_any_text_gives_a_light_or_one_clear_error(spec):
    try:
        name, _ = parse_light(spec)
    except RelightError:
        return
    assert re.fullmatch(r"[\w.+-]+", name)


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.sampled_from(KINDS),
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.dictionaries(
                st.sampled_from(
                    ["name", "kind", "parts", "to_light", "position", "coefficients", "map", "C"]
                ),
                inner,
            )
        ),
        max_leaves=12,
    )
)
def test_any_json_gives_lights_or_one_clear_error(tmp_path_factory, entry):
    path = tmp_path_factory.mktemp("lights") / "lights.json"
    path.write_text(json.dumps({"lights": [entry]}))
    with contextlib.suppress(RelightError):
        load_lights(path)
