import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.cameras import load_posed_set
from capture.images import read_exr, read_image
from capture.ply import read_ply
from capture.sim import Rig, simulate_posed_set, simulate_video
from capture.sim.camera_path import CameraPath
from capture.sim.lamp import PulseTrain
from capture.transfer import to_linear
from capture.video.colour import rgb_from_frame
from capture.video.reader import decode_video, probe_video


@pytest.fixture(scope="module")
def posed(small_rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_posed_set(tmp_path_factory.mktemp("posed"), small_rig.config, rig=small_rig).parent


@pytest.fixture(scope="module")
def video(small_rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_video(tmp_path_factory.mktemp("video"), small_rig.config, rig=small_rig)


def test_a_posed_set_reads_back_with_its_pictures(posed: Path, small_rig: Rig) -> None:
    posed_set = load_posed_set(posed)
    assert len(posed_set.frames) == small_rig.config.posed_frames
    assert posed_set.flash_offset_cam_m == pytest.approx(small_rig.config.flash_offset_cam_m)
    assert [frame.index for frame in posed_set.frames if frame.flash == 1] == [0, 5, 10]
    assert [frame.index for frame in posed_set.frames if frame.split == "val"] == [9, 10, 11]
    for frame in posed_set.frames:
        assert frame.file is not None
        assert frame.linear is not None
        assert frame.mask is not None
        stored, exact = to_linear(read_image(frame.file), posed_set.transfer), read_exr(frame.linear)
        assert stored.shape == exact.shape == (160, 128, 3)
        sigma = small_rig.config.sensor.noise_sigma(exact)
        inside = (exact > 0.02) & (exact < 0.8)  # away from black and white, where the noise is cut off
        # Noise as configured; the 8-bit code adds a little, half floats next to nothing.
        assert np.std(((stored - exact) / sigma)[inside]) == pytest.approx(1.0, abs=0.15)
        assert read_image(frame.mask).dtype == np.uint8


@pytest.mark.parametrize(("every", "flag"), [(0, 0), (1, 1)])
def test_the_flash_of_a_posed_set_may_never_fire_or_always(
    small_rig: Rig, tmp_path: Path, every: int, flag: int
) -> None:
    config = replace(small_rig.config, flash_every=every)
    posed_set = load_posed_set(simulate_posed_set(tmp_path, config, rig=replace(small_rig, config=config)))
    assert {frame.flash for frame in posed_set.frames} == {flag}
    assert [frame.index for frame in posed_set.frames if frame.split == "val"] == [9, 10, 11]


def test_exposure_drifts_over_a_posed_set_but_not_in_its_linear_truth(
    small_rig: Rig, posed: Path, tmp_path: Path
) -> None:
    sensor = replace(small_rig.config.sensor, exposure_drift=0.4)
    config = replace(small_rig.config, sensor=sensor)
    drifting = simulate_posed_set(tmp_path, config, rig=replace(small_rig, config=config)).parent
    for name, part in (("0000", 0.5 / 12), ("0011", 11.5 / 12)):
        linear = read_exr(posed / f"linear/{name}.exr")
        assert np.array_equal(linear, read_exr(drifting / f"linear/{name}.exr"))
        stored = to_linear(read_image(drifting / f"frames/{name}.png"), "srgb")
        mid = (linear > 0.1) & (linear < 0.5)
        # 8-bit codes and noise average out over thousands of pixels.
        assert np.median(stored[mid] / linear[mid]) == pytest.approx(1 + 0.4 * part, rel=0.01)


def test_truth_files_have_the_forms_that_tools_read(posed: Path) -> None:
    validation = load_posed_set(posed / "cameras_val.json")
    assert [frame.camera.name for frame in validation.frames] == ["0009", "0010", "0011"]
    albedo, normals = read_exr(posed / "gt/albedo_0010.exr"), read_exr(posed / "gt/normal_0010.exr")
    depth, mask = read_image(posed / "gt/depth_0010.png"), read_image(posed / "mask/0010.png")
    assert depth.dtype == np.uint16
    on = mask == 255
    assert 0.4 < np.median(depth[on]) / 20_000 < 0.65
    assert np.allclose(np.linalg.norm(normals[on], axis=-1), 1, atol=2e-3)  # half floats
    lights = json.loads((posed / "lights.json").read_text())["lights"]
    assert [light["kind"] for light in lights] == [
        "captured",
        "directional",
        "directional",
        "directional",
        "environment",
        "environment",
        "point",
    ]
    for light in lights[1:]:
        for name in ("0009", "0010"):
            assert read_exr(posed / f"relight/{light['name']}_{name}.exr").shape == albedo.shape
    assert read_exr(posed / lights[4]["map"]).shape == (64, 128, 3)
    assert read_ply(posed / "points.ply").normals is None
    assert read_ply(posed / "gt/surface.ply").normals is not None


def test_the_video_reads_back_with_its_times_tags_and_truth(video: Path, small_rig: Rig) -> None:
    assert video.name == "VID_20261102_101530.mp4"
    info = probe_video(video)
    decoded = list(decode_video(info))
    truths = [json.loads(line) for line in (video.parent / "truth.jsonl").read_text().splitlines()]
    posed = load_posed_set(video.parent / "cameras.json")
    assert len(decoded) == len(truths) == len(posed.frames)
    for shown, truth, frame in zip(decoded, truths, posed.frames, strict=True):
        assert shown.pts_s == pytest.approx(truth["pts_s"], abs=1 / 90_000)  # a tick of the file
        assert frame.pts_s == truth["pts_s"]
        assert frame.flash == truth["flash"]
        assert frame.file is None
    assert {truth["flash"] for truth in truths} == {0, 1, None}


def test_the_video_shows_the_rigs_frames(video: Path, small_rig: Rig) -> None:
    info = probe_video(video)
    for shown, frame in zip(decode_video(info), small_rig.frames(), strict=True):
        error = rgb_from_frame(shown.picture, info.colour).astype(float) - frame.rgb
        # Of H.264 at crf 18 with half-resolution chroma, on a noisy picture.
        assert np.sqrt(np.mean(error**2)) < 8
        assert np.abs(error.mean()) < 1.5
        if frame.truth.index == 10:
            break


def test_validation_views_of_a_video_are_noise_free_and_beside_the_path(video: Path) -> None:
    views = load_posed_set(video.parent / "cameras_val.json")
    assert [frame.flash for frame in views.frames] == [0, 1]
    for frame in views.frames:
        assert frame.file is not None
        assert frame.linear is not None
        stored, exact = to_linear(read_image(frame.file), views.transfer), read_exr(frame.linear)
        # Half an 8-bit code at the bright end, and half floats.
        assert np.abs(stored - np.clip(exact, 0, 1)).max() < 0.006
        assert (video.parent / f"relight/env2_{frame.camera.name}.exr").exists()


def test_a_recording_can_be_hevc_on_a_turned_sensor(small_rig: Rig, tmp_path: Path) -> None:
    config = replace(
        small_rig.config,
        codec="hevc",
        color_range="full",
        matrix="bt601",
        rotation_deg=90,
        validation_views=0,
        path=CameraPath(duration_s=0.3),
    )
    rig = replace(small_rig, config=config, pulses=PulseTrain.schedule(config.lamp, 0.3))
    steps: list[tuple[str, float]] = []
    info = probe_video(simulate_video(tmp_path, config, lambda step, part: steps.append((step, part)), rig))
    assert (info.width, info.height) == (160, 128)
    assert info.rotation_deg == 90
    assert len(list(decode_video(info))) == 9
    parts = [part for _, part in steps]
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    assert not (tmp_path / "cameras_val.json").exists()
