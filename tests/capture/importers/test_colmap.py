import numpy as np
import pytest

from capture.colmap_model import write_colmap_model
from capture.errors import SourceError
from capture.images import natural_order
from capture.importers import ImportOptions, import_source
from capture.ply import PointCloud, read_ply, write_ply


@pytest.fixture
def project(pictures, cameras):
    """A COLMAP project: images/, sparse/0 with posed images and two coloured points, masks aside."""
    (pictures / "masks").rename(pictures / "other")
    (pictures / "points.ply").unlink()
    write_colmap_model(pictures / "sparse/0", {f"{camera.name}.jpg": camera for camera in cameras})
    with (pictures / "sparse/0/points3D.txt").open("a") as file:
        file.write("1 0.5 1 2 255 0 51 0.4 1 2\n2 -0.5 1 2 0 255 0 0.4\n")
    return pictures


def run(source, out, **options):
    return import_source([source], out, ImportOptions(**options))


@pytest.mark.parametrize("part", ["", "sparse/0"])
def test_poses_pictures_and_sparse_points_arrive(project, cameras, tmp_path, part):
    session = run(project / part, tmp_path / "S")
    assert (session.status, session.info["source"]["units"]) == ("complete", "arbitrary")
    assert [r.source for r in session.frames] == [f"{i:04d}.jpg" for i in range(4)]
    assert all(r.flash is None and r.reasons == ("untagged",) for r in session.frames)
    found = session.load_scene_cameras()
    for i, record in enumerate(session.frames):
        assert (session.path / record.file).read_bytes() == (project / "images" / record.source).read_bytes()
        assert np.abs(found[i].cam_from_world - cameras[i].cam_from_world).max() < 1e-14  # rounding
    cloud = read_ply(session.points_path)
    assert cloud.points.tolist() == [[0.5, 1, 2], [-0.5, 1, 2]]
    assert cloud.colors == pytest.approx(np.array([[1, 0, 0.2], [0, 1, 0]]), abs=1e-6)  # float32


def test_a_flash_list_tags_the_frames(project, tmp_path):
    (tmp_path / "flash.csv").write_text("0000.jpg,1\n0001.jpg,0\n0002.jpg,0\n")
    session = run(project, tmp_path / "S", flash_list=tmp_path / "flash.csv")
    assert [r.flash for r in session.frames] == [1, 0, 0, None]


def test_a_dense_cloud_is_preferred(project, tmp_path):
    (project / "dense").mkdir()
    write_ply(project / "dense/fused.ply", PointCloud(np.ones((7, 3), np.float32)))
    assert len(read_ply(run(project, tmp_path / "S").points_path).points) == 7


def test_the_part_with_the_most_images_is_taken(project, cameras, tmp_path):
    write_colmap_model(project / "sparse/1", {"0000.jpg": cameras[0]})
    assert len(run(project, tmp_path / "S").frames) == 4


def test_masks_named_as_colmap_does_are_used(project, tmp_path):
    (project / "masks").mkdir()
    for file in (project / "other").iterdir():
        file.rename(project / "masks" / f"{file.stem}.jpg.png")
    session = run(project, tmp_path / "S")
    assert all(session.load_mask(record) is not None for record in session.frames)


def test_missing_pictures_are_said(project, tmp_path):
    (project / "images/0002.jpg").unlink()
    with pytest.raises(SourceError, match=r"Frame 2: .*0002\.jpg"):
        run(project, tmp_path / "S")
    (project / "images").rename(project / "photos")
    with pytest.raises(SourceError, match="no folder 'images'"):
        run(project, tmp_path / "S")


def test_frames_are_numbered_as_people_count():
    names = ["b10.jpg", "b9.jpg", "a/2.jpg", "a/10.jpg", "b9_2.jpg", "07", "7x"]
    assert sorted(names, key=natural_order) == [
        "07",
        "7x",
        "a/2.jpg",
        "a/10.jpg",
        "b9.jpg",
        "b9_2.jpg",
        "b10.jpg",
    ]
