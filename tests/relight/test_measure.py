"""Measuring against a small truth with known errors, and against one in which things are missing."""

import json
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from capture.cameras import Camera, PosedFrame, PosedSet, save_posed_set
from capture.errors import RelightError
from capture.images import read_image, write_exr, write_png
from capture.transfer import to_display
from relight.errors import TruthError
from relight.lighting import CapturedLight, DirectionalLight, RoomLight, shade
from relight.measure import CAPTURED, Rendering, measure
from relight.measure_table import format_markdown, format_table, measure_rows
from relight.truth import load_truth

SIZE = 48
NAMES = ("0001", "0002", "0003")


def scene(name):
    """A disk of a head with an albedo, normals and radiances that differ from view to view."""
    random = np.random.default_rng(int(name))
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    x, y = (columns - SIZE / 2) / 18, (rows - SIZE / 2) / 18
    mask = (x * x + y * y < 1).astype(float)
    normals = np.stack([x, -y, np.sqrt(np.maximum(1 - x * x - y * y, 0.0))], axis=-1) * mask[..., None]

    def smooth(high):
        picture = cv2.GaussianBlur(random.uniform(0, 1, size=(SIZE, SIZE, 3)), (0, 0), 2)
        return (0.1 + high * picture) * mask[..., None]

    return {
        "mask": mask,
        "normals": normals,
        "albedo": smooth(0.7),
        "captured": smooth(0.8),
        "lamp": smooth(2.0),
    }


def write_truth(folder):
    """Three validation views, the second lit; the lamp's pictures are there for two of them."""
    intrinsics = np.array([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]])
    frames = []
    for index, name in enumerate(NAMES):
        truth = scene(name)
        write_png(folder / "mask" / f"{name}.png", (255 * truth["mask"]).astype(np.uint8))
        write_exr(folder / "linear" / f"{name}.exr", truth["captured"], half=False)
        write_exr(folder / "gt" / f"albedo_{name}.exr", truth["albedo"], half=False)
        write_exr(folder / "gt" / f"normal_{name}.exr", truth["normals"], half=False)
        if index < 2:
            write_exr(folder / "relight" / f"lamp_{name}.exr", truth["lamp"], half=False)
        camera = Camera(name, SIZE, SIZE, intrinsics, np.eye(4), flash=index % 2)
        frames.append(PosedFrame(camera, index, flash=index % 2, split="val"))
    frames.append(PosedFrame(Camera("0009", SIZE, SIZE, intrinsics, np.eye(4)), 9, flash=0, split="train"))
    save_posed_set(PosedSet("rig", tuple(frames), "srgb", None, folder), folder / "cameras.json")
    lights = [
        {"name": "captured", "kind": "captured"},
        {"name": "lamp", "kind": "directional", "to_light": [0, 0, 1]},
    ]
    (folder / "lights.json").write_text(json.dumps({"lights": lights}))


@pytest.fixture
def folder(tmp_path):
    for name in ("mask", "linear", "gt", "relight"):
        (tmp_path / name).mkdir()
    write_truth(tmp_path)
    return tmp_path


def perfect(camera, lights, flash):
    truth = scene(camera.name)
    assert flash == NAMES.index(camera.name) % 2
    radiance = {CAPTURED: truth["captured"]} | {name: truth[name] for name in lights if name != CAPTURED}
    return Rendering(truth["albedo"], truth["normals"], truth["mask"], radiance)


def changed(**changes):
    """A renderer that is perfect but for some maps, each changed by a function."""

    def render(camera, lights, flash):
        right = perfect(camera, lights, flash)
        parts = {"albedo": right.albedo, "normals_world": right.normals_world, "mask": right.mask}
        parts |= {name: changes[name](value) for name, value in parts.items() if name in changes}
        radiance = {
            name: changes.get(name, lambda value: value)(value) for name, value in right.radiance.items()
        }
        return Rendering(**parts, radiance=radiance)

    return render


def test_only_the_validation_views_and_the_new_lights_are_measured(folder):
    truth = load_truth(folder)
    assert [view.camera.name for view in truth.views] == list(NAMES)
    assert truth.lights == {"lamp": DirectionalLight((0, 0, 1))}
    assert truth.notes == ()


def test_a_perfect_rendering_has_no_error(folder):
    result = measure(load_truth(folder), perfect)
    # Equal but for float32 files: no error at all, or one of 1e-7, far above 100 dB.
    for measures in (result["captured"], result["albedo"], result["lights"]["lamp"]):
        assert measures["psnr_db"] is None or measures["psnr_db"] > 100
    assert result["captured"]["ssim"] == pytest.approx(1.0)
    assert result["albedo"]["scales"] == pytest.approx([1, 1, 1])
    assert result["normals"]["mean_deg"] < 1e-4
    assert result["normals"]["within_10_deg"] == 1.0
    assert (result["mask"]["iou"], result["mask"]["alpha_error"], result["mask"]["silhouette_f"]) == (1, 0, 1)
    assert result["missing"] == []
    assert [result[part]["views"] for part in ("captured", "albedo", "normals", "mask")] == [3, 3, 3, 3]
    assert result["lights"]["lamp"]["views"] == 2


def test_scales_of_albedo_and_lights_are_free_but_the_captured_view_is_not_scaled(folder):
    tint = np.array([0.5, 1.25, 2.0])
    result = measure(load_truth(folder), changed(albedo=lambda a: a * tint, lamp=lambda r: r * tint))
    assert result["albedo"]["scales"] == pytest.approx(1 / tint)
    assert result["lights"]["lamp"]["scales"] == pytest.approx(1 / tint)
    # What is left is rounding: the scaled values are the truth's.
    assert result["albedo"]["psnr_db"] is None or result["albedo"]["psnr_db"] > 100
    darker = measure(load_truth(folder), changed(captured=lambda r: 0.5 * r))
    assert darker["captured"]["psnr_db"] < 20


def test_psnr_is_the_mean_over_views_of_display_values_at_one_exposure(folder):
    def noisy(radiance):
        return radiance + np.random.default_rng(int(1e6 * radiance.sum()) % 1000).normal(
            scale=0.02, size=radiance.shape
        )

    result = measure(load_truth(folder), changed(lamp=noisy))["lights"]["lamp"]
    truths = [scene(name)["lamp"][scene(name)["mask"] > 0] for name in NAMES[:2]]
    values = [noisy(scene(name)["lamp"])[scene(name)["mask"] > 0] for name in NAMES[:2]]
    scales = (np.concatenate(values) * np.concatenate(truths)).sum(0) / (np.concatenate(values) ** 2).sum(0)
    exposure = 1 / np.percentile(np.concatenate(truths), 99.5)
    errors = [
        np.mean((to_display(exposure * scales * v).astype(float) - to_display(exposure * t)) ** 2)
        for v, t in zip(values, truths, strict=True)
    ]
    # The files hold float32, the plain sum here is double.
    assert result["exposure"] == pytest.approx(exposure, rel=1e-6)
    assert result["scales"] == pytest.approx(scales, rel=1e-6)
    assert result["psnr_db"] == pytest.approx(
        np.mean([-10 * math.log10(error) for error in errors]), abs=1e-4
    )


def test_turned_normals_are_off_by_the_turn(folder):
    angle = math.radians(12.0)
    turn = np.array(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    result = measure(load_truth(folder), changed(normals_world=lambda n: n @ turn.T))
    # A normal at an angle t from the axis of the turn moves by less: 2 asin(sin(6 degrees) sin t).
    assert 9 < result["normals"]["mean_deg"] < result["normals"]["median_deg"] <= 12.0
    missing = measure(load_truth(folder), changed(normals_world=np.zeros_like))
    assert missing["normals"]["mean_deg"] == 90.0


def test_broken_pixels_are_not_passed_over(folder):
    def broken(values):
        values = values.copy()
        values[SIZE // 2, SIZE // 2] = np.nan
        return values

    result = measure(
        load_truth(folder), changed(albedo=broken, normals_world=broken, captured=broken, lamp=broken)
    )
    assert result["captured"]["psnr_db"] is None
    assert result["albedo"]["psnr_db"] is None
    assert result["normals"]["mean_deg"] is None
    assert result["lights"]["lamp"]["psnr_db"] is None
    json.dumps(result, allow_nan=False)


def test_frames_stand_in_for_linear_pictures(folder):
    cameras = json.loads((folder / "cameras.json").read_text())
    for entry in cameras["frames"][:3]:
        name = entry["name"]
        (folder / "linear" / f"{name}.exr").unlink()
        entry["file"] = f"frames/{name}.png"
        (folder / "frames").mkdir(exist_ok=True)
        display = to_display(scene(name)["captured"])
        write_png(folder / "frames" / f"{name}.png", np.round(255 * display).astype(np.uint8))
    (folder / "cameras.json").write_text(json.dumps(cameras))
    # Rounding to 8 bits is an error of 1 / (255 sqrt(12)): 58.9 dB, more where black is exact.
    assert measure(load_truth(folder), perfect)["captured"]["psnr_db"] == pytest.approx(58.9, abs=0.5)


@pytest.mark.parametrize(
    ("pattern", "part", "sentence"),
    [
        ("linear/*", "captured", "Captured views are not measured"),
        ("gt/albedo_*", "albedo", "there is no gt/albedo_XXXX.exr"),
        ("gt/normal_*", "normals", "there is no gt/normal_XXXX.exr"),
        ("relight/*", "lights", "The light lamp is not measured: there is no relight/lamp_XXXX.exr"),
        ("lights.json", "lights", "no lights.json"),
        (
            "mask/*",
            "mask",
            "Views without a mask, or in which it is empty, are not measured: 0001, 0002, 0003",
        ),
    ],
)
def test_what_is_missing_is_said_and_the_rest_is_measured(folder, pattern, part, sentence):
    for file in folder.glob(pattern):
        file.unlink()
    result = measure(load_truth(folder), perfect)
    assert part not in result
    assert any(sentence in said for said in result["missing"])
    if part != "mask":
        rest = {"captured", "albedo", "normals", "lights", "mask"} - {part}
        assert rest <= result.keys()
    assert format_table(result)


def test_truth_without_a_split_measures_all_views_and_says_so(folder):
    cameras = json.loads((folder / "cameras.json").read_text())
    cameras["frames"] = [{**entry, "split": None} for entry in cameras["frames"][:3]]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    truth = load_truth(folder)
    assert len(truth.views) == 3
    assert "no validation views" in truth.notes[0]


def test_view_without_any_head_is_left_out(folder):
    write_png(folder / "mask" / "0002.png", np.zeros((SIZE, SIZE), np.uint8))
    result = measure(load_truth(folder), perfect)
    assert result["captured"]["views"] == 2
    assert "0002" in result["missing"][0]


def test_unusable_truths_say_why(folder, tmp_path):
    with pytest.raises(TruthError, match="is no folder"):
        load_truth(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(TruthError, match=r"has no cameras\.json"):
        load_truth(tmp_path / "empty")
    write_exr(folder / "gt" / "albedo_0001.exr", np.ones((8, 16, 3)))
    with pytest.raises(TruthError, match=r"albedo_0001\.exr has 16 x 8 pixels, its camera 48 x 48"):
        measure(load_truth(folder), perfect)
    write_exr(folder / "gt" / "albedo_0001.exr", np.ones((SIZE, SIZE)))
    with pytest.raises(TruthError, match="is grey"):
        measure(load_truth(folder), perfect)
    (folder / "lights.json").write_text("{}")
    with pytest.raises(RelightError, match=r"lights\.json"):
        load_truth(folder)


def test_progress_goes_from_nothing_to_all(folder):
    told = []
    measure(load_truth(folder), perfect, lambda stage, fraction: told.append((stage, fraction)))
    assert told[0] == ("evaluate", 0.0)
    assert told[-1] == ("evaluate", 1.0)
    assert [fraction for _, fraction in told] == sorted(fraction for _, fraction in told)


def test_table_has_a_row_for_every_measure(folder):
    result = measure(load_truth(folder), changed(captured=lambda r: 0.9 * r))
    result |= {"session": "S", "portrait": "solve", "fit": {"total_s": 12.3, "seconds": {"solve": 9.8}}}
    names = [name for name, _, _ in measure_rows(result)]
    assert names == [
        "captured view, PSNR",
        "captured view, SSIM",
        "albedo, PSNR",
        "albedo, median relative error",
        "normals, mean angle",
        "normals, median angle",
        "normals within 10°",
        "light lamp, PSNR",
        "mask, IoU at 0.5",
        "mask, error near the silhouette",
        "mask, F-score of the outline",
        "time of the fit",
        "peak memory of the fit",
        "time of a view",
    ]
    text = format_table(result)
    assert "S solve, measured against rig in 3 views" in text
    assert "12.3 s" in text
    assert format_markdown(result).count("\n") == len(names) + 1
    # A result that went through JSON says the same.
    assert format_table(json.loads(json.dumps(result, allow_nan=False))) == text


def test_true_maps_under_the_lights_of_portrait_a_score_as_known():
    """The formulas against a path tracer: what true albedo and normals give without shadows and gloss."""
    root = Path(__file__).resolve().parents[2]
    folder = Path(os.environ.get("RELIGHT_PORTRAIT_A", root.parent / "shared" / "portrait_A"))
    if not (folder / "cameras_val.json").is_file():
        pytest.skip("portrait_A is not here; set RELIGHT_PORTRAIT_A to its folder")
    truth = load_truth(folder)
    views = {view.camera.name: view for view in truth.views}

    def render(camera, lights, flash):
        return true_maps_under(views[camera.name], folder, lights)

    result = measure(truth, render)
    assert result["missing"] == []
    assert result["views"] == 15
    # Known from an independent computation, with one scale a channel: 29.4 and 31.1 dB without shadows, 18.5
    # dB for the point light, whose shadows are black. The directional pictures are half precision.
    scores = {name: measures["psnr_db"] for name, measures in result["lights"].items()}
    assert scores["env1"] == pytest.approx(29.4, abs=0.1)
    assert scores["env2"] == pytest.approx(31.1, abs=0.1)
    assert scores["point"] == pytest.approx(18.5, abs=0.1)
    assert min(scores["dir1"], scores["dir2"], scores["dir3"]) > 60
    assert result["normals"]["mean_deg"] == 0
    assert result["mask"]["iou"] == 1


def true_maps_under(view, folder, lights):
    """The view's true maps, shaded where they are exact: no shadows, no gloss."""
    camera = view.camera
    depth = read_image(folder / "gt" / f"depth_{camera.name}.png") / 20000.0
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    cam = (pixels @ np.linalg.inv(camera.K).T) * depth[..., None]
    points = (cam - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]

    class TrueMaps:
        albedo = torch.from_numpy(view.albedo())
        normals_world = torch.from_numpy(view.normals_world())
        mask = torch.from_numpy(view.mask()).float()
        shading = torch.ones_like(mask)
        points_world = torch.from_numpy(points).float()

    radiance = {}
    for name, light in lights.items():
        shown = RoomLight() if isinstance(light, CapturedLight) else light
        radiance[name] = shade(shown, TrueMaps(), c_room=(1, 1, 1)).numpy()
    return Rendering(view.albedo(), view.normals_world(), view.mask(), radiance)
