import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from capture.errors import SessionError, SourceError
from capture.images import read_image, write_png
from capture.importers import ImportOptions, import_source
from capture.session import Session
from capture.transfer import to_linear

PORTRAIT_A = Path(os.environ.get("RELIGHT_PORTRAIT_A", Path(__file__).parents[3] / "../shared/portrait_A"))


def run(source, out, **options):
    return import_source([source], out, ImportOptions(**options))


def test_everything_that_is_an_input_arrives(save, posed, pictures, cameras, tmp_path):
    seen = []
    session = import_source(
        [save(posed)], tmp_path / "S", ImportOptions(), lambda stage, share: seen.append(share)
    )
    assert seen[-1] == 1.0
    session = Session.open(session.path)
    assert (session.status, session.repairs) == ("complete", [])
    assert [r.index for r in session.frames] == [0, 10, 20, 30]
    assert [r.flash for r in session.frames] == [1, 0, None, 0]
    assert [r.split for r in session.frames] == ["train", "val", "train", "train"]
    assert [r.reasons for r in session.frames] == [(), (), ("untagged",), ()]
    assert session.info["source"]["units"] == "metres"
    found = session.load_scene_cameras()
    for i, record in enumerate(session.frames):
        assert record.file == f"frames/{record.index:06d}.jpg"
        assert record.source == f"images/{i:04d}.jpg"
        original = (pictures / record.source).read_bytes()
        assert (session.path / record.file).read_bytes() == original
        assert session.mask_path(record.index).read_bytes() == (pictures / f"masks/{i:04d}.png").read_bytes()
        assert np.array_equal(found[record.index].K, cameras[i].K)
        # the rotation was orthonormalised and went through a quaternion: rounding
        assert np.abs(found[record.index].cam_from_world - cameras[i].cam_from_world).max() < 1e-14
        image = read_image(pictures / record.source)
        assert np.array_equal(session.load_radiance(record), to_linear(image, "srgb"))
    assert session.points_path.read_bytes() == (pictures / "points.ply").read_bytes()


def test_the_flash_position_is_taken_with_its_provenance_and_its_colour_is_not(save, posed, tmp_path):
    session = run(save(posed), tmp_path / "S")
    calibration = json.loads(session.calibration_path.read_text())
    assert calibration["flash_offset_cam_m"] == {
        "value": [0.01, -0.02, 0.003],
        "unit": "m",
        "sigma": None,
        "source": "stated by the cameras.json of 'small'",
    }
    everything = b"".join(path.read_bytes() for path in session.path.rglob("*.json*"))
    assert b"C_flash" not in everything
    assert b"linear/" not in everything


def test_what_is_optional_may_be_absent(save, posed, pictures, tmp_path):
    del posed["flash"], posed["transfer"], posed["name"], posed["units"]
    for frame in posed["frames"]:
        for key in ("flash", "mask", "split", "index", "linear"):
            del frame[key]
    (pictures / "points.ply").unlink()
    session = run(save(posed), tmp_path / "S")
    assert [r.flash for r in session.frames] == [None] * 4
    assert all(r.reasons == ("untagged",) and r.split is None for r in session.frames)
    assert [r.index for r in session.frames] == [0, 1, 2, 3]
    assert not session.points_path.exists()
    assert not session.masks_dir.exists()
    assert not session.calibration_path.exists()


def test_each_frame_may_have_its_own_camera(save, posed, pictures, tmp_path):
    write_png(pictures / "images/wide.png", np.zeros((6, 20, 3), np.uint8))
    posed["frames"][3] |= {
        "file": "images/wide.png",
        "mask": None,
        "width": 20,
        "height": 6,
        "K": [[30, 0, 10], [0, 30, 3], [0, 0, 1]],
        "distortion": [0.1, 0.02, 0, 0, 0.003],
    }
    session = run(save(posed), tmp_path / "S")
    camera = session.load_scene_cameras()[30]
    assert (camera.width, camera.height, camera.K[0, 0]) == (20, 6, 30.0)
    assert camera.distortion[:5].tolist() == [0.1, 0.02, 0, 0, 0.003]
    assert session.load_mask(session.frames[3]) is None


def test_a_frame_without_a_file_is_recorded_without_a_picture(save, posed, tmp_path):
    del posed["frames"][2]["file"]
    session = run(save(posed), tmp_path / "S")
    assert session.frames[2].file is None
    assert "no_picture" in session.frames[2].reasons
    assert sorted(session.load_scene_cameras()) == [0, 10, 30]


def test_cameras_alone_are_no_source(save, posed, tmp_path):
    for frame in posed["frames"]:
        del frame["file"]
    with pytest.raises(SourceError, match="names a picture"):
        run(save(posed), tmp_path / "S")
    assert not (tmp_path / "S").exists()


def test_masks_that_were_taken_away_are_done_without(save, posed, pictures, tmp_path):
    shutil.rmtree(pictures / "masks")
    assert not run(save(posed), tmp_path / "S").masks_dir.exists()


def test_options_replace_what_the_source_says(save, posed, pictures, tmp_path):
    (pictures / "masks").rename(tmp_path / "mine")
    (pictures / "points.ply").rename(tmp_path / "mine.ply")
    (tmp_path / "lit.txt").write_text("0002.jpg\n")
    session = run(
        save(posed),
        tmp_path / "S",
        masks=tmp_path / "mine",
        points=tmp_path / "mine.ply",
        transfer="gamma:2.2",
        flash_list=tmp_path / "lit.txt",
    )
    assert [r.flash for r in session.frames] == [0, 0, 1, 0]
    assert session.info["image"]["transfer"] == "gamma:2.2"
    assert len(list(session.masks_dir.iterdir())) == 4
    assert session.points_path.read_bytes() == (tmp_path / "mine.ply").read_bytes()


def test_masks_of_other_kinds_become_grey_pngs(save, posed, pictures, tmp_path):
    write_png(pictures / "masks/0000.png", np.full((12, 16, 3), 200, np.uint8))
    write_png(pictures / "masks/0001.png", np.full((12, 16), 65535, np.uint16))
    session = run(save(posed), tmp_path / "S")
    assert (session.load_mask(session.frames[0]) == 200).all()
    assert (session.load_mask(session.frames[1]) == 255).all()


def test_an_interrupted_import_is_completed(save, posed, pictures, tmp_path):
    def stop(stage, share):
        if stage == "copying pictures" and share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_source([save(posed)], tmp_path / "S", ImportOptions(), stop)
    assert Session.open(tmp_path / "S").status == "interrupted"
    session = run(pictures, tmp_path / "S")
    assert (session.status, [r.index for r in session.frames]) == ("complete", [0, 10, 20, 30])
    assert len(session.load_scene_cameras()) == 4
    with pytest.raises(SessionError, match="not empty"):
        run(pictures, tmp_path / "S")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda p, s: (s / "images/0001.jpg").unlink(), r"Frame 10: .*0001\.jpg cannot be read"),
        (lambda p, s: (s / "images/0001.jpg").write_bytes(b""), "Frame 10"),
        (
            lambda p, s: (
                (s / "images/0001.jpg").rename(s / "images/0001.gif")
                and p["frames"][1].update(file="images/0001.gif")
            ),
            "convert",
        ),
        (
            lambda p, s: p.update(width=17),
            r"Frame 0 \(.*0000.jpg\) is 16 x 12 pixels, its camera says 17 x 12",
        ),
        (lambda p, s: (s / "masks/0001.png").unlink(), "Frame 10: the mask"),
        (
            lambda p, s: write_png(s / "masks/0001.png", np.zeros((5, 5), np.uint8)),
            "Frame 10: the mask .* 5 x 5",
        ),
        (lambda p, s: (s / "points.ply").write_bytes(b"ply\n"), r"points\.ply"),
        (lambda p, s: p["frames"][3].update(index=0), "index 0 is used twice"),
        (lambda p, s: p["frames"][3].update(R=np.eye(3)[:, ::-1].tolist()), "frame 3: .*reflection"),
        (lambda p, s: p["frames"][3].update(t=[0, 0, None]), "frame 3"),
        (lambda p, s: p.update(units="arbitrary"), "metres"),
    ],
)
def test_what_does_not_fit_is_one_sentence_that_names_the_frame(
    save, posed, pictures, tmp_path, damage, words
):
    damage(posed, pictures)
    with pytest.raises(SourceError, match=words):
        run(save(posed), tmp_path / "S")


def test_options_that_do_not_fit_are_refused(save, posed, pictures, tmp_path):
    save(posed)
    (pictures / "masks/0003.png").unlink()
    for options, words in (
        ({"masks": pictures / "masks"}, "no mask for images/0003"),
        ({"masks": tmp_path / "none"}, "no folder of masks"),
        ({"points": tmp_path / "none.ply"}, r"none\.ply cannot be read"),
        ({"flash_list": tmp_path / "none.txt"}, r"none\.txt cannot be read"),
        ({"poses": pictures / "cameras.json"}, "--poses is for videos"),
    ):
        with pytest.raises(SourceError, match=words):
            run(pictures, tmp_path / "S", **options)
        assert not (tmp_path / "S").exists()


@pytest.mark.skipif(not PORTRAIT_A.is_dir(), reason=f"the measured portrait is not at {PORTRAIT_A}")
def test_the_measured_portrait_is_imported_whole(tmp_path):
    session = run(PORTRAIT_A, tmp_path / "S")
    assert len(session.frames) == 100
    assert sum(record.flash for record in session.frames) == 20
    assert sum(record.split == "val" for record in session.frames) == 15
    assert all(record.usable for record in session.frames)
    for record in session.frames[::33]:
        original = PORTRAIT_A / record.source
        assert (session.path / record.file).read_bytes() == original.read_bytes()
