import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.cameras import Camera, load_posed_set, save_posed_set
from capture.errors import SourceError

HALF = np.sqrt(0.5)
ROTATION = [[HALF, 0.0, -HALF], [0.0, 1.0, 0.0], [HALF, 0.0, HALF]]


def content(**changes):
    """A cameras.json of three frames, as an object."""
    frames = [
        {
            "index": i,
            "file": f"frames/{i:04d}.jpg",
            "flash": flag,
            "split": "train",
            "R": ROTATION,
            "t": [0.0, 0.1 * i, 0.5],
        }
        for i, flag in enumerate((1, 0, None))
    ]
    K = [[500.0, 0.0, 32.0], [0.0, 510.0, 24.0], [0.0, 0.0, 1.0]]
    return {
        "name": "set",
        "units": "metres",
        "transfer": "srgb",
        "width": 64,
        "height": 48,
        "K": K,
        "frames": frames,
    } | changes


def load(folder, value):
    (folder / "cameras.json").write_text(json.dumps(value))
    return load_posed_set(folder)


def test_shared_and_own_fields_are_read(tmp_path):
    value = content(distortion=[0.1, 0.01, 0, 0, 0])
    value["frames"][1] |= {"width": 32, "K": [[9, 0, 16], [0, 9, 24], [0, 0, 1]], "distortion": [0.0] * 5}
    posed = load(tmp_path, value)
    first, second, third = (frame.camera for frame in posed.frames)
    assert (first.name, first.width, first.height, first.flash) == ("0000", 64, 48, 1)
    assert first.distortion.tolist() == [0.1, 0.01, 0, 0, 0]
    assert (second.width, second.height, second.K[0, 0], second.flash) == (32, 48, 9.0, 0)
    assert second.distortion.size == 0
    assert third.flash is None
    assert posed.frames[0].file == tmp_path / "frames/0000.jpg"
    assert (posed.transfer, posed.units, posed.flash_offset_cam_m) == ("srgb", "metres", None)


def test_the_camera_centre_maps_to_the_origin(tmp_path):
    camera = load(tmp_path, content()).frames[1].camera
    # rounding of a product of 3 terms of size 1
    assert camera.cam_from_world @ [*camera.centre_world, 1.0] == pytest.approx([0, 0, 0, 1], abs=1e-15)


def test_scaling_keeps_the_direction_of_every_pixel():
    camera = Camera("a", 640, 481, np.array([[500.0, 0, 300], [0, 510, 250], [0, 0, 1]]), np.eye(4))
    small = camera.scaled(0.25)
    assert (small.width, small.height) == (160, 120)
    corner = np.linalg.solve(camera.K, [640, 481, 1.0])
    assert small.K @ corner == pytest.approx([160, 120, 1], abs=1e-12)  # rounding at a size of 1e2


def test_flags_and_splits_come_from_the_lists_where_frames_do_not_say(tmp_path):
    value = content(splits={"flash": [1], "val": [2]})
    for frame in value["frames"]:
        del frame["flash"], frame["split"]
    posed = load(tmp_path, value)
    assert [frame.flash for frame in posed.frames] == [0, 1, 0]
    assert [frame.split for frame in posed.frames] == ["train", "train", "val"]


def test_a_frame_may_have_no_file_and_a_time(tmp_path):
    value = content()
    value["frames"][2] = {"R": ROTATION, "t": [0, 0, 1], "pts_s": 1.25}
    frame = load(tmp_path, value).frames[2]
    assert (frame.file, frame.index, frame.camera.name, frame.pts_s, frame.flash) == (
        None,
        2,
        "0002",
        1.25,
        None,
    )


@pytest.mark.parametrize("rows", [3, 4])
def test_a_pose_may_be_one_matrix(tmp_path, rows):
    value = content()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = ROTATION, [1, 2, 3]
    value["frames"] = [{"cam_from_world": pose[:rows].tolist()}]
    found = load(tmp_path, value).frames[0].camera.cam_from_world
    assert np.abs(found - pose).max() < 1e-15  # the rotation is orthonormalised: rounding


def test_rounding_is_taken_out_of_rotations(tmp_path):
    value = content()
    value["frames"][0]["R"] = np.round(ROTATION, 5).tolist()
    rotation = load(tmp_path, value).frames[0].camera.cam_from_world[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-15
    assert np.abs(rotation - ROTATION).max() < 1e-5  # what the rounding took away


def test_the_flash_offset_is_found_from_positions_that_move_with_the_camera(tmp_path):
    value, offset = content(), np.array([0.02, -0.01, 0.003])
    for frame in value["frames"]:
        frame["flash_position"] = (np.array(frame["R"]).T @ (offset - frame["t"])).tolist()
    assert load(tmp_path, value).flash_offset_cam_m == pytest.approx(offset, abs=1e-12)  # rounding
    stated = value | {"flash": {"offset_cam": [0.02, -0.01, 0.0035], "C_flash": [1, 1, 1]}}
    assert load(tmp_path, stated).flash_offset_cam_m.tolist() == [0.02, -0.01, 0.0035]


def test_a_flash_that_stands_still_has_no_offset(tmp_path):
    value = content()
    for frame in value["frames"]:
        frame["flash_position"] = [0.5, 0.5, 0.5]
    assert load(tmp_path, value).flash_offset_cam_m is None
    with pytest.raises(SourceError, match="contradicts"):
        load(tmp_path, value | {"flash": {"offset_cam": [0, 0, 0]}})


def test_writing_and_reading_give_the_same_set(tmp_path):
    posed = load(tmp_path, content(flash={"offset_cam": [0.1, 0.2, 0.3]}, distortion=[0.1, 0, 0, 0, 0]))
    posed = replace(posed, frames=(replace(posed.frames[0], pts_s=0.1 + 0.2, split="val"), *posed.frames[1:]))
    (tmp_path / "again").mkdir()
    save_posed_set(posed, tmp_path / "cameras.json")
    again = load_posed_set(tmp_path / "cameras.json")
    assert again.flash_offset_cam_m.tolist() == posed.flash_offset_cam_m.tolist()
    assert (again.name, again.transfer, again.units) == (posed.name, posed.transfer, posed.units)
    for found, original in zip(again.frames, posed.frames, strict=True):
        for name in ("index", "file", "mask", "linear", "flash", "split", "pts_s"):
            assert getattr(found, name) == getattr(original, name)
        # 1e-15: the rotation passes once more through the orthonormalisation
        assert np.abs(found.camera.cam_from_world - original.camera.cam_from_world).max() < 1e-15
        assert np.array_equal(found.camera.K, original.camera.K)
        assert np.array_equal(found.camera.distortion, original.camera.distortion)
        assert (found.camera.name, found.camera.flash) == (original.camera.name, original.camera.flash)


def with_frame(**changes):
    value = content()
    value["frames"][1] |= changes
    return value


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (with_frame(R=np.diag([1.0, 1.0, -1.0]).tolist()), "frame 1.*reflection"),
        (with_frame(R=np.diag([1.0, 1.0, 1.001]).tolist()), "frame 1.*orthonormal"),
        (with_frame(R=None), 'frame 1: "R" is missing'),
        (with_frame(t=[1, 2]), 'frame 1: "t"'),
        (with_frame(cam_from_world=3), "frame 1.*cam_from_world"),
        (
            with_frame(cam_from_world=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]),
            "frame 1.*last row",
        ),
        (with_frame(index=0), "frame 1.*index 0 is used twice"),
        (with_frame(index=-1), 'frame 1: "index"'),
        (with_frame(file="other/0000.png"), "frame 1.*'0000' is already"),
        (with_frame(flash=2), 'frame 1: "flash"'),
        (with_frame(K=[[-5, 0, 1], [0, 5, 1], [0, 0, 1]]), "frame 1.*focal"),
        (with_frame(K=[[5, 1, 1], [0, 5, 1], [0, 0, 1]]), "frame 1.*skew"),
        (with_frame(distortion=[0.1, 0.2, 0.3]), "frame 1.*distortion"),
        (with_frame(distortion=[0.1] * 12), "frame 1.*distortion"),
        (with_frame(name="../0001"), "frame 1.*name"),
        (with_frame(width=0), 'frame 1: "width"'),
        (with_frame(file="a\0b"), "frame 1.*NUL"),
        (content(frames=[]), "empty"),
        (content(frames={}), "frames"),
        (content(width=None), 'frame 0: "width" is missing'),
        (content(units="inches"), "inches"),
        (content(transfer="film"), "film"),
        (content(splits=[1]), "splits"),
        (content(flash={"offset_cam": [1]}), "offset_cam"),
    ],
)
def test_a_malformed_set_names_the_place(tmp_path, value, words):
    with pytest.raises(SourceError, match=words):
        load(tmp_path, value)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, number):
    text = json.dumps(content()).replace("500.0", number)
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(SourceError, match="finite"):
        load_posed_set(tmp_path)


@given(data=st.data())
def test_damage_is_read_or_refused(damage, scratch, data):
    text = json.dumps(content(splits={"val": [1]}, flash={"offset_cam": [0, 0, 0]})).encode()
    (scratch / "cameras.json").write_bytes(data.draw(damage(text)))
    with contextlib.suppress(SourceError):
        posed = load_posed_set(scratch)
        assert all(np.isfinite(frame.camera.cam_from_world).all() for frame in posed.frames)


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
VALUES = st.recursive(
    SCALARS, lambda v: st.lists(v, max_size=4) | st.dictionaries(st.text(max_size=5), v, max_size=3)
)


@given(value=VALUES, key=st.sampled_from(sorted({*content(), "splits", "flash", "distortion"})))
def test_any_value_under_a_shared_key_is_read_or_refused(scratch, key, value):
    (scratch / "cameras.json").write_text(json.dumps(content() | {key: value}))
    with contextlib.suppress(SourceError):
        load_posed_set(scratch)


@given(
    value=VALUES,
    key=st.sampled_from(
        [
            "index",
            "file",
            "mask",
            "flash",
            "split",
            "R",
            "t",
            "K",
            "cam_from_world",
            "pts_s",
            "flash_position",
            "name",
        ]
    ),
)
def test_any_value_under_a_frame_key_is_read_or_refused(scratch, key, value):
    (scratch / "cameras.json").write_text(json.dumps(with_frame(**{key: value})))
    with contextlib.suppress(SourceError):
        load_posed_set(scratch)
