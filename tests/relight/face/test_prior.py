"""Position maps lie on the face, its normals are right, crops shift with their camera, files keep it all."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from face_shapes import sitter
from scipy.spatial import cKDTree

from relight.errors import PlanError
from relight.face import find_face, load_face, save_face
from relight.face.frame import head_frame
from relight.face.plane import Plane
from relight.face.surface import HALF_ANGLE_RAD, texel_places, unroll
from relight.face.textures import half_texture, sample_texture


def ellipsoid(count=40_000):
    """Points and normals of an ellipsoid the size of a head, and its frame with the axis in its middle."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    axes = np.array([0.075, 0.115, 0.095])
    way = np.stack([ring * np.cos(phi), z, ring * np.sin(phi)], axis=1)
    normals = way / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    up, forward = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    frame = head_frame(way * axes, normals, Plane((1.0, 0.0, 0.0), 0.0), up, forward)
    return way * axes, normals, axes, replace(frame, origin=(0.0, 0.0, 0.0), breadth=0.15)


def test_a_formulas_surface_is_unrolled_exactly():
    points, normals, axes, frame = ellipsoid()
    surface = unroll(points, normals, None, frame)
    heights, angles = texel_places()
    y = frame.breadth * heights[:, None]
    inside = np.abs(y) < 0.9 * axes[1]
    flat = np.sqrt(np.clip(1 - (y / axes[1]) ** 2, 0, None))
    radius = flat / np.sqrt((np.sin(angles) / axes[0]) ** 2 + (np.cos(angles) / axes[2]) ** 2)
    found = np.hypot(surface.points[..., 0].numpy(), surface.points[..., 2].numpy())
    wanted = np.broadcast_to(inside, found.shape)
    assert surface.valid.numpy()[wanted].all()
    # Tangent planes of neighbours 1.4 mm away, radii of curvature of 60 mm: 0.02 mm, more where it is steep.
    np.testing.assert_allclose(found[wanted], radius[wanted], atol=1.5e-4)
    normal = surface.points.numpy() / axes**2
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = (normal * surface.normals_world.numpy()).sum(axis=-1)[wanted]
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 2.0


def test_columns_are_mirror_images_and_run_from_the_subjects_right_to_the_left():
    points, normals, _, frame = ellipsoid()
    surface = unroll(points, normals, None, frame)
    assert surface.points[128, 10, 0] < 0 < surface.points[128, 245, 0]
    assert surface.points[10, 128, 1] > surface.points[245, 128, 1]
    mirrored = surface.points.flip(1) * torch.tensor([-1.0, 1.0, 1.0])
    both = surface.valid & surface.valid.flip(1)
    # The points are not mirrored, and texels at the outer columns lie between few of them.
    error = (surface.points - mirrored).norm(dim=-1)[both]
    assert error.quantile(0.98) < 3e-4
    assert error.max() < 2.5e-3
    _, angles = texel_places()
    np.testing.assert_allclose(angles, -angles[::-1], atol=1e-12)
    assert angles[-1] < HALF_ANGLE_RAD


def test_nothing_to_unroll_gives_an_empty_surface():
    _, _, _, frame = ellipsoid()
    surface = unroll(np.full((3, 3), np.nan), np.full((3, 3), np.nan), None, frame)
    assert not surface.valid.any()


def test_the_texels_lie_on_the_sitter(face):
    assert face.decision.found
    surface = face.prior.surface
    wanted = surface.region & surface.valid
    exact, normals, _ = sitter(count=200_000)
    distances, near = cKDTree(exact).query(surface.points[wanted].numpy())
    # A coarse cloud of 8,000 points, 4 mm apart.
    assert np.median(distances) < 0.001
    assert np.percentile(distances, 95) < 0.004
    cosine = (normals[near] * surface.normals_world[wanted].numpy()).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 8.0


def test_a_position_map_projects_the_surface_and_hides_what_is_turned_away(face):
    prior = face.prior
    first, last = prior.indices[0], prior.indices[-1]  # from the subject's right and left
    for index in (first, last):
        shown = prior.position_map(index)
        camera = prior.cameras[index]
        towards = torch.from_numpy(camera.centre_world).float() - prior.surface.points
        facing = (prior.surface.normals_world * towards).sum(dim=-1)
        assert bool((facing[shown.visible] > 0).all())
        points = prior.surface.points[shown.visible].double().numpy()
        in_camera = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        pixels = in_camera @ camera.K.T
        np.testing.assert_allclose(
            shown.uv_px[shown.visible].numpy(), pixels[:, :2] / pixels[:, 2:], atol=2e-3
        )
    # One sees the left half of the texture (the subject's right), the other the right half.
    right, left = (prior.position_map(index).visible.float().mean(dim=0) for index in (first, last))
    assert right[:128].sum() > 3 * right[128:].sum()
    assert left[128:].sum() > 3 * left[:128].sum()


def test_a_crop_and_a_zoom_see_the_same_texels_elsewhere(face):
    prior = face.prior
    index = prior.indices[3]
    camera = prior.cameras[index]
    K = np.array([[2.0, 0, -60.0], [0, 2.0, -80.0], [0, 0, 1.0]]) @ camera.K
    crop = replace(camera, K=K, width=300, height=280)
    whole, part = prior.position_map(index), prior.position_map(index, crop)
    seen = whole.visible
    expected = 2.0 * whole.uv_px[seen] - torch.tensor([60.0, 80.0])
    torch.testing.assert_close(part.uv_px[seen], expected, rtol=0, atol=2e-3)
    assert prior.face_normals(index, crop).mask.shape == (280, 300)


def test_the_faces_normals_are_drawn_without_gaps(face):
    prior = face.prior
    index = prior.indices[3]
    drawn = prior.face_normals(index)
    inside = drawn.mask > 0
    lengths = drawn.normals_world.norm(dim=-1)
    torch.testing.assert_close(lengths[inside], torch.ones(int(inside.sum())))
    assert not lengths[~inside].any()
    # The middle of the face as the frame sees it is full.
    uv_px = prior.position_map(index).uv_px[110:150, 118:138].reshape(-1, 2).long()
    assert drawn.mask[uv_px[:, 1], uv_px[:, 0]].mean() > 0.97
    # In a zoom of four times, too.
    camera = prior.cameras[index]
    K = np.array([[4.0, 0, -380.0], [0, 4.0, -380.0], [0, 0, 1.0]]) @ camera.K
    zoom = replace(camera, K=K, width=256, height=256)
    assert prior.face_normals(index, zoom).mask.mean() > 0.9


def test_the_sitters_own_colour_comes_back_as_a_symmetric_texture(face):
    prior = face.prior
    # Pictures whose colour at a pixel is that of the point there: x of the world, which is odd.
    textures = []
    for index in prior.indices:
        camera = prior.cameras[index]
        picture = torch.zeros(1, camera.height, camera.width)
        seen = prior.position_map(index)
        place = seen.uv_px[seen.visible].long()
        picture[0, place[:, 1], place[:, 0]] = prior.surface.points[seen.visible][:, 0].abs()
        textures.append(picture)
    by_index = dict(zip(prior.indices, textures, strict=True))
    texture, count = prior.texture_of(by_index.__getitem__, prior.indices)
    half, weight = half_texture(texture, (count > 0).float())
    both = weight == 2
    assert both.float().mean() > 0.3
    left = prior.surface.points[:, :128, 0].abs()
    # Pixels are 1.4 mm wide; those at the outline stay empty between texels.
    assert (half[0][both] - left[both]).abs().median() < 0.002


def test_a_frame_without_a_map_is_named(face):
    with pytest.raises(KeyError, match="99"):
        face.prior.position_map(99)
    with pytest.raises(ValueError, match="at least one"):
        face.prior.texture_of(lambda index: torch.zeros(3, 8, 8), [99])


def test_a_saved_prior_is_the_same_when_it_is_loaded(face, tmp_path):
    save_face(face.prior, tmp_path / "face")
    loaded = load_face(tmp_path / "face")
    assert loaded.indices == face.prior.indices
    assert loaded.plane == face.prior.plane
    assert loaded.report == face.prior.report
    index = loaded.indices[2]
    torch.testing.assert_close(loaded.position_map(index).uv_px, face.prior.position_map(index).uv_px)
    assert torch.equal(loaded.cosines, face.prior.cosines)
    assert torch.equal(loaded.surface.region, face.prior.surface.region)


def test_damaged_newer_and_missing_priors_are_refused(face, tmp_path):
    with pytest.raises(PlanError, match="missing"):
        load_face(tmp_path)
    save_face(face.prior, tmp_path)
    content = json.loads((tmp_path / "face.json").read_text())
    for change, match in (
        ({"version": 99}, "version 99"),
        ({"schema": "else"}, "no face prior"),
        ({"source": "guess"}, "unknown"),
        ({"cameras": content["cameras"][:1]}, "cosines"),
        ({"plane": {"normal": [0, 0, 0], "offset": 0}}, "zero"),
    ):
        (tmp_path / "face.json").write_text(json.dumps(content | change))
        with pytest.raises(PlanError, match=match):
            load_face(tmp_path)
    (tmp_path / "face.json").write_text(json.dumps(content))
    (tmp_path / "face.safetensors").write_bytes(b"\x00" * 100)
    with pytest.raises(PlanError, match="damaged"):
        load_face(tmp_path)


def test_a_prior_on_a_device_is_the_same(face):
    moved = face.prior.to("cpu")
    assert torch.equal(moved.position_map(0).uv_px, face.prior.position_map(0).uv_px)


def test_albedo_keeps_a_dark_fringe_out_of_the_face(head_cloud, half_circle):
    points, normals, albedo = head_cloud
    fringe = (points[:, 1] > 0.02) & (points[:, 2] > 0)
    dark = np.where(fringe[:, None], 0.02, 0.4) * np.ones(3)
    region = find_face(points, normals, dark, half_circle).prior.surface
    above = (region.points[..., 1] > 0.03) & region.region
    below = (region.points[..., 1] < 0.0) & region.region
    assert above.sum() < 0.05 * below.sum()
    assert albedo.shape == dark.shape


def test_sampling_a_frame_gives_the_face_in_the_texture(face):
    prior = face.prior
    index = prior.indices[3]
    drawn = prior.face_normals(index)
    texture, defined = sample_texture(drawn.normals_world.permute(2, 0, 1), prior.position_map(index))
    known = defined > 0
    cosine = (texture.permute(1, 2, 0)[known] * prior.normals_uv[known]).sum(dim=-1)
    assert cosine.median() > 0.98  # to the texture's pixels and back: normals of 1.4 mm beside
