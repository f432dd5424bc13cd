"""A portrait whose every number is known, a sphere, through `evaluate`."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from capture.cameras import Camera, PosedFrame, PosedSet, load_posed_set, save_posed_set
from capture.frame_record import FrameRecord
from capture.images import write_exr, write_png
from capture.session import Session
from relight.alignment import Similarity
from relight.errors import GeometryError, PortraitError, TruthError
from relight.evaluate import evaluate
from relight.measure_table import format_table
from relight.portrait import Portrait
from relight.reflectance import Reflectance
from relight.stage_cache import StageCache

RADIUS_M, DISTANCE_M, SIZE = 0.1, 0.5, 96
ALBEDO = np.array([0.6, 0.4, 0.3])
C_ROOM = (0.5, 0.5, 0.4)
TO_LIGHT = np.array([0.6, 0.0, -0.8])


def sphere_portrait(count=30_000):
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    normals = torch.tensor(
        np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1), dtype=torch.float32
    )
    albedo = torch.tensor(ALBEDO, dtype=torch.float32).expand(count, 3)
    return Portrait(
        points=RADIUS_M * normals,
        normals_world=normals,
        albedo=albedo,
        room_radiance=albedo * torch.tensor(C_ROOM),
        shading=torch.ones(count),
        gloss=torch.ones(count),
        flash_bounce=torch.zeros(count),
        confidence=torch.ones(count),
        albedo_sigma=torch.zeros(count),
        normal_sigma_rad=torch.zeros(count),
        residual=torch.zeros(count),
        spacing=RADIUS_M * np.sqrt(4 * np.pi / count),
        c_room=C_ROOM,
        c_flash=(0.1, 0.1, 0.1),
        flash_offset_cam_m=(0.0, 0.0, 0.0),
        reflectance=Reflectance(),
        bounce_scale=1.0,
        info={},
    )


def sphere_camera(name):
    cam_from_world = np.eye(4)
    cam_from_world[2, 3] = DISTANCE_M
    focal = 1.8 * SIZE
    intrinsics = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    return Camera(name, SIZE, SIZE, intrinsics, cam_from_world, flash=0)


def write_truth(folder):
    """What the camera sees of the sphere, by intersecting its rays."""
    camera = sphere_camera("0000")
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    half = rays[..., 2] * DISTANCE_M
    root = half**2 - DISTANCE_M**2 + RADIUS_M**2
    hit = root > 0
    points = rays * (half - np.sqrt(np.maximum(root, 0)))[..., None] - [0, 0, DISTANCE_M]
    normals = np.where(hit[..., None], points / RADIUS_M, 0.0)
    albedo = np.where(hit[..., None], ALBEDO, 0.0)
    lit = 0.5 + 0.5 * np.maximum(normals @ TO_LIGHT, 0.0)
    for name in ("mask", "linear", "gt", "relight"):
        (folder / name).mkdir(parents=True)
    write_png(folder / "mask" / "0000.png", (255 * hit).astype(np.uint8))
    write_exr(folder / "linear" / "0000.exr", albedo * C_ROOM)
    write_exr(folder / "gt" / "albedo_0000.exr", albedo)
    write_exr(folder / "gt" / "normal_0000.exr", normals)
    write_exr(folder / "relight" / "side_0000.exr", albedo * lit[..., None])
    frame = PosedFrame(camera, 0, flash=0, split="val")
    save_posed_set(PosedSet("sphere", (frame,), "srgb", None, folder), folder / "cameras.json")
    light = {"name": "side", "kind": "directional", "to_light": TO_LIGHT.tolist(), "ambient": 0.5}
    (folder / "lights.json").write_text(json.dumps({"lights": [light]}))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("evaluate") / "S"
    with Session.create(path, source={"kind": "test"}, width=SIZE, height=SIZE) as created:
        folder = created.portraits_dir / "solve"
    sphere_portrait().save(folder)
    metrics = {"total_s": 1.5, "seconds": {"solve": 1.0}, "points": 30_000}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    write_truth(path.parent / "truth")
    return path


def test_a_known_sphere_scores_as_its_maps_are_exact(session):
    result = evaluate(session, session.parent / "truth")
    assert (result["session"], result["portrait"], result["truth"]) == ("S", "solve", "sphere")
    assert result["missing"] == []
    # Albedo and room are constant, so no splat can be wrong; the files are half floats, 1 part in 2048.
    assert result["captured"]["psnr_db"] > 60
    assert result["albedo"]["psnr_db"] > 60
    assert result["albedo"]["scales"] == pytest.approx([1, 1, 1], abs=1e-3)
    # A pixel is 2.9 mm wide, 1.7 degrees of the sphere where it faces the camera and more at its edge.
    assert result["normals"]["median_deg"] < 1.5
    assert result["lights"]["side"]["psnr_db"] > 35
    # The outline is right to half a pixel of a disk 36 pixels in radius.
    assert result["mask"]["iou"] > 0.95


def test_a_portrait_in_a_world_of_its_own_scores_as_in_the_truths(session, tmp_path):
    truth = tmp_path / "truth"
    write_truth(truth)
    train = []  # around the sphere; without pictures, for only their poses matter here
    for k, angle in enumerate(np.linspace(-0.6, 0.6, 5)):
        cam_from_world = sphere_camera("0000").cam_from_world.copy()
        cam_from_world[:3, :3] = Rotation.from_rotvec([0.2 * angle, angle, 0]).as_matrix()
        camera = replace(sphere_camera(f"{k + 1:04d}"), cam_from_world=cam_from_world)
        train.append(PosedFrame(camera, k + 1, file=truth / f"{k + 1:04d}.png", flash=0, split="train"))
    validation = load_posed_set(truth / "cameras.json")
    save_posed_set(replace(validation, frames=(*validation.frames, *train)), truth / "cameras.json")

    elsewhere = Similarity(
        2.5, Rotation.from_euler("xyz", [1.0, 2.0, 3.0]).as_matrix(), np.array([1.0, -2, 3])
    )
    with Session.create(tmp_path / "S", source={"kind": "test"}, width=SIZE, height=SIZE) as found:
        for frame in train:
            file = found.write_frame(frame.index, np.zeros((SIZE, SIZE, 3), np.uint8))
            found.append_frame(
                FrameRecord(
                    index=frame.index, file=file, width=SIZE, height=SIZE, flash=0, source=frame.file.name
                )
            )
        found.save_scene_cameras({frame.index: elsewhere.camera(frame.camera) for frame in train})
    StageCache(found).store("poses", "key", settings={}, report={})
    sphere_portrait().transformed(elsewhere).save(found.portraits_dir / "solve")

    result = evaluate(found.path, truth)
    assert result["alignment"]["scale"] == pytest.approx(1 / 2.5)
    assert result["alignment"]["rotation_worst_deg"] < 1e-5
    known = evaluate(session, session.parent / "truth")
    # The same but for the rounding of float32 positions, which moves an outline's pixel now and then.
    assert result["captured"]["psnr_db"] == pytest.approx(known["captured"]["psnr_db"], abs=0.5)
    assert result["normals"]["median_deg"] == pytest.approx(known["normals"]["median_deg"], abs=0.02)
    assert result["lights"]["side"]["psnr_db"] == pytest.approx(known["lights"]["side"]["psnr_db"], abs=0.5)
    assert result["mask"]["iou"] == pytest.approx(known["mask"]["iou"], abs=0.005)
    assert "rotation error" in format_table(result)


def test_a_found_world_needs_the_true_cameras(session, tmp_path):
    with Session.create(tmp_path / "S", source={"kind": "test"}, width=SIZE, height=SIZE) as found:
        file = found.write_frame(0, np.zeros((SIZE, SIZE, 3), np.uint8))
        found.append_frame(FrameRecord(index=0, file=file, width=SIZE, height=SIZE, flash=0, source="9.png"))
        found.save_scene_cameras({0: sphere_camera("a")})
    StageCache(found).store("poses", "key", settings={}, report={})
    sphere_portrait().save(found.portraits_dir / "solve")
    with pytest.raises(GeometryError, match="0 cameras are known in both worlds"):
        evaluate(found.path, session.parent / "truth")


def test_what_the_fit_took_stands_beside_its_errors(session):
    result = evaluate(session, session.parent / "truth")
    assert result["fit"] == {"total_s": 1.5, "seconds": {"solve": 1.0}}
    assert result["time"]["view_s"] > 0
    assert "time of the fit" in format_table(result)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_missing_portraits_and_truths_are_named(session, tmp_path):
    with pytest.raises(PortraitError, match="paper"):
        evaluate(session, session.parent / "truth", "paper")
    with pytest.raises(TruthError, match=r"cameras\.json"):
        evaluate(session, tmp_path)
