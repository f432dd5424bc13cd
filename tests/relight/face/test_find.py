"""Which provider is asked, what each says without its files, and that they agree with one another."""

import sys
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from face_shapes import arc_of_cameras, seen_by, shape

from capture.cameras import Camera
from relight.errors import PlanError
from relight.face import FaceConfig, decide, find_face
from relight.face.head import up_and_towards
from relight.face.landmarks import MIDDLE, PAIRS, detect_landmarks
from relight.face.map_files import facing, load_position_maps
from relight.face.symmetry import Symmetry
from relight.upright import upright_camera

# Where the landmarks that are used lie on the sitter of seed 3, metres: eyes, mouth, nose; middle.
_PLACES = {
    33: (-0.044, 0.0, 0.075),
    263: (0.044, 0.0, 0.075),
    133: (-0.018, -0.002, 0.08),
    362: (0.018, -0.002, 0.08),
    61: (-0.022, -0.076, 0.083),
    291: (0.022, -0.076, 0.083),
    98: (-0.014, -0.046, 0.088),
    327: (0.014, -0.046, 0.088),
    10: (0.0, 0.07, 0.08),
    168: (0.0, 0.008, 0.088),
    1: (0.0, -0.036, 0.108),
    152: (0.0, -0.112, 0.078),
}


class _Landmarker:
    """Stands for MediaPipe's: its picture is the number of a frame, its landmarks the projected places."""

    cameras: ClassVar[dict[int, Camera]] = {}

    @classmethod
    def create_from_options(cls, options):
        if "broken" in options.base_options.model_asset_path:
            raise RuntimeError("not a task file")
        return cls()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def detect(self, image):
        index = int(image.data[0, 0, 0])
        if index not in self.cameras:
            return SimpleNamespace(face_landmarks=[])
        camera = self.cameras[index]
        marks = [SimpleNamespace(x=0.5, y=0.5, z=0.0) for _ in range(478)]
        for number, place in _PLACES.items():
            x, y, z = camera.cam_from_world[:3, :3] @ np.array(place) + camera.cam_from_world[:3, 3]
            u, v, _ = camera.K @ np.array([x / z, y / z, 1.0])
            marks[number] = SimpleNamespace(x=u / camera.width, y=v / camera.height, z=0.0)
        return SimpleNamespace(face_landmarks=[marks])


@pytest.fixture
def mediapipe(monkeypatch, half_circle):
    """A package of that name, with what is used of it."""
    module = ModuleType("mediapipe")
    module.Image = lambda image_format, data: SimpleNamespace(data=data)
    module.ImageFormat = SimpleNamespace(SRGB=1)
    vision = SimpleNamespace(
        FaceLandmarkerOptions=lambda **given: SimpleNamespace(**given),
        RunningMode=SimpleNamespace(IMAGE="image"),
        FaceLandmarker=_Landmarker,
    )
    module.tasks = SimpleNamespace(
        BaseOptions=lambda model_asset_path: SimpleNamespace(model_asset_path=model_asset_path), vision=vision
    )
    monkeypatch.setitem(sys.modules, "mediapipe", module)
    monkeypatch.setattr(_Landmarker, "cameras", dict(half_circle))
    return module


def picture_of(index):
    return np.full((256, 256, 3), index, np.uint8)


def test_landmarks_and_the_cloud_give_the_same_face(mediapipe, tmp_path, head_cloud, half_circle, face):
    model = tmp_path / "face_landmarker.task"
    model.write_bytes(b"model")
    result = find_face(*head_cloud, half_circle, FaceConfig(model=str(model)), load_srgb=picture_of)
    assert result.prior.source == "landmarks"
    assert "landmark" in result.decision.reason
    assert np.degrees(result.prior.plane.angle_to(face.prior.plane)) < 1.0
    one, other = (r.prior.position_map(3) for r in (result, face))
    both = one.visible & other.visible
    # The landmarks' up may lean some degrees from the cameras': the textures shift along the face.
    assert (one.uv_px - other.uv_px)[both].norm(dim=-1).median() < 6.0


def test_a_turned_picture_gives_the_same_landmarks(mediapipe, monkeypatch, tmp_path, half_circle):
    model = tmp_path / "face_landmarker.task"
    model.write_bytes(b"model")
    straight = detect_landmarks(model, half_circle, picture_of)
    # The stored camera is a quarter turn from upright: its upright one is what the landmarker sees.
    turned = {index: upright_camera(camera, 270) for index, camera in half_circle.items()}
    found = detect_landmarks(model, turned, picture_of, rotation_deg=90)
    for index, camera in half_circle.items():
        u, v = straight[index].T
        np.testing.assert_allclose(found[index], np.stack([v, camera.width - u], axis=1), atol=1e-9)


def test_a_missing_package_is_one_sentence(monkeypatch, tmp_path, head_cloud, half_circle):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    model = tmp_path / "face_landmarker.task"
    model.write_bytes(b"model")
    with pytest.raises(PlanError, match="mediapipe is not installed"):
        find_face(*head_cloud, half_circle, FaceConfig(model=str(model)), load_srgb=picture_of)


def test_a_missing_or_broken_model_is_one_sentence(mediapipe, tmp_path, half_circle):
    with pytest.raises(PlanError, match="does not exist"):
        detect_landmarks(tmp_path / "none.task", half_circle, picture_of)
    broken = tmp_path / "broken.task"
    broken.write_bytes(b"")
    with pytest.raises(PlanError, match="cannot be loaded"):
        detect_landmarks(broken, half_circle, picture_of)


def test_a_model_that_sees_no_face_is_one_sentence(mediapipe, monkeypatch, tmp_path, half_circle):
    model = tmp_path / "face_landmarker.task"
    model.write_bytes(b"model")
    monkeypatch.setattr(_Landmarker, "cameras", {})
    with pytest.raises(PlanError, match="a face in 0 of 7 frames"):
        detect_landmarks(model, half_circle, picture_of)


def test_the_landmarks_that_are_used_are_those_of_the_fake():
    assert {*MIDDLE, *(number for pair in PAIRS for number in pair)} == _PLACES.keys()


def write_maps(folder, prior, indices, channels=3):
    for index in indices:
        values = np.zeros((256, 256, channels), np.float32)
        values[..., :2] = prior.position_map(index).uv_px.numpy() - 0.5
        values[~prior.surface.valid.numpy(), :2] = values[128, 128, :2]
        np.save(folder / f"{index:06d}.npy", values)


def test_given_maps_are_used_as_they_are_where_the_cloud_agrees(tmp_path, head_cloud, half_circle, face):
    write_maps(tmp_path, face.prior, face.prior.indices)
    result = find_face(*head_cloud, half_circle, FaceConfig(maps=str(tmp_path)))
    prior = result.prior
    assert prior.source == "maps"
    for index in (1, 3, 5):
        one, other = prior.position_map(index), face.prior.position_map(index)
        both = one.visible & other.visible
        assert both.sum() > 0.6 * other.visible.sum()
        np.testing.assert_allclose(one.uv_px[both], other.uv_px[both], atol=1e-3)
    # The pairing of the columns tells the plane: to what lifting by pixels of 1.4 mm allows.
    assert np.degrees(prior.plane.angle_to(face.prior.plane)) < 1.5
    wanted = prior.surface.region & face.prior.surface.region
    cosine = (prior.normals_uv * face.prior.normals_uv).sum(dim=-1)[wanted]
    assert cosine.median() > 0.95


def test_a_map_of_another_face_is_not_believed_in_that_frame(tmp_path, head_cloud, half_circle, face):
    write_maps(tmp_path, face.prior, face.prior.indices)
    wrong = np.load(tmp_path / "000003.npy")
    wrong[..., 0] += 40.0
    np.save(tmp_path / "000003.npy", wrong)
    prior = find_face(*head_cloud, half_circle, FaceConfig(maps=str(tmp_path))).prior
    assert 3 not in prior.indices or prior.position_map(3).visible.float().mean() < 0.02
    assert prior.position_map(2).visible.float().mean() > 0.1


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (np.zeros((128, 128, 3), np.float32), "must be"),
        (np.full((256, 256, 3), np.nan, np.float32), "finite"),
        (np.random.default_rng(0).random((256, 256, 3)).astype(np.float32), "0..1"),
        (np.full((256, 256, 2), 1e5, np.float32), "in pixels"),
        (np.zeros((256, 256, 3), np.complex64), "finite"),
    ],
)
def test_what_is_no_position_map_is_refused(tmp_path, half_circle, values, match):
    np.save(tmp_path / "000001.npy", values)
    with pytest.raises(PlanError, match=match):
        load_position_maps(tmp_path, half_circle)


def test_folders_without_maps_are_refused(tmp_path, half_circle):
    with pytest.raises(PlanError, match="does not exist"):
        load_position_maps(tmp_path / "none", half_circle)
    (tmp_path / "000001.npy").write_bytes(b"no array")
    with pytest.raises(PlanError, match="cannot be read"):
        load_position_maps(tmp_path, half_circle)
    (tmp_path / "000001.npy").rename(tmp_path / "000099.npy")
    with pytest.raises(PlanError, match="by frame numbers"):
        load_position_maps(tmp_path, half_circle)


def test_a_map_turned_over_does_not_face():
    i, j = np.mgrid[0:256, 0:256].astype(float)
    folded = np.stack([np.where(j < 180, j, 360 - j), i], axis=-1)
    shown = facing(folded)
    assert shown[:, 2:170].all()
    assert not shown[:, 190:254].any()


def test_no_prior_where_none_is_wanted_or_there_is_no_face(half_circle):
    cloud = seen_by(shape("ball"), half_circle)
    none = find_face(*cloud, half_circle, FaceConfig(provider="none"))
    assert none.prior is None
    ball = find_face(*cloud, half_circle)
    assert ball.prior is None
    assert "many planes" in ball.decision.reason
    assert ball.report["found"] is False
    assert find_face(*cloud, {}).prior is None


def test_reports_are_plain_numbers(face):
    import json

    assert json.loads(json.dumps(face.report, allow_nan=False)) == face.report


def test_an_unknown_provider_is_refused():
    with pytest.raises(ValueError, match="choose one of"):
        FaceConfig(provider="magic")
    assert FaceConfig().resolved == "cloud"
    assert FaceConfig(model="a", maps="b").resolved == "maps"
    assert FaceConfig(provider="landmarks", maps="b").resolved == "landmarks"


def test_landmarks_without_pictures_are_refused(head_cloud, half_circle):
    with pytest.raises(PlanError, match="pictures"):
        find_face(*head_cloud, half_circle, FaceConfig(provider="landmarks", model="x"))


@pytest.mark.parametrize(
    ("change", "found", "word"),
    [
        ({}, False, "no nose"),
        ({"agreement": 0.3}, False, "symmetric"),
        ({"overlap": 0.1}, False, "other half"),
        ({"rival": 0.95}, False, "many planes"),
        ({"sigma_rad": 0.2}, False, "degrees only"),
    ],
)
def test_every_refusal_has_its_reason(change, found, word, face):
    numbers = {"agreement": 0.8, "overlap": 0.9, "rival": 0.5, "sigma_rad": 0.01, "sigma_offset": 0.01}
    decision = decide(Symmetry(face.prior.plane, **(numbers | change), radius=0.1), None)
    assert decision.found is found
    assert word in decision.reason
    assert not decision.reason.endswith(".")


def test_cameras_all_round_and_turned_ones_still_have_an_up():
    cameras = arc_of_cameras(-180, 150, count=12)
    up, towards = up_and_towards(np.zeros((5, 3)), cameras, 0)
    np.testing.assert_allclose(up, [0, 1, 0], atol=0.1)
    assert abs(up @ towards) < 1e-9
    turned = {index: upright_camera(camera, 270) for index, camera in arc_of_cameras(-60, 60).items()}
    up, towards = up_and_towards(np.zeros((5, 3)), turned, 90)
    np.testing.assert_allclose(up, [0, 1, 0], atol=0.1)
    np.testing.assert_allclose(towards, [0, 0, 1], atol=0.1)
