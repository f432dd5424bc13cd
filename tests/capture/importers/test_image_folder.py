"""Plain pictures as a source; what a source brings left out; a calibration given beside it."""

import json

import numpy as np
import pytest

from capture.errors import CalibrationError, SourceError, TaggingError
from capture.images import write_exr, write_jpeg, write_png
from capture.importers import ImportOptions, import_source
from capture.session import Session
from capture.transfer import to_display
from relight.cli import main

COUNT, WIDTH, HEIGHT = 14, 48, 32


def lit_pictures(lit):
    """[K, H, W, 3] radiance of a near disc and a far wall; the flash adds to the disc most."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    near = np.hypot((x - WIDTH / 2) / WIDTH, (y - HEIGHT / 2) / HEIGHT) < 0.3
    rng = np.random.default_rng(5)
    texture = rng.uniform(0.05, 0.15, (HEIGHT, WIDTH, 3))
    drift = np.linspace(0.95, 1.05, len(lit))
    gain = np.where(near, 1.5, 0.2)[..., None]
    noise = rng.normal(0, 0.001, (len(lit), HEIGHT, WIDTH, 3))
    return np.array([texture * a * (1 + gain * f) for a, f in zip(drift, lit, strict=True)]) + noise


def write_pictures(folder, lit, suffix=".png"):
    folder.mkdir(exist_ok=True)
    for k, radiance in enumerate(lit_pictures(lit)):
        path = folder / f"IMG_{k}{suffix}"  # without leading zeros: IMG_10 comes after IMG_9
        codes = np.round(255 * to_display(np.clip(radiance, 0, 1).astype(np.float32), "srgb"))
        if suffix == ".exr":
            write_exr(path, radiance.astype(np.float32))
        else:
            (write_png if suffix == ".png" else write_jpeg)(path, codes.astype(np.uint8))
    return folder


@pytest.fixture
def lit():
    return [int(k % 4 == 1) for k in range(COUNT)]


def run(source, out, **options):
    return import_source([source], out, ImportOptions(**options))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_plain_pictures_become_a_session_without_poses_whose_flash_is_seen(tmp_path, lit, suffix):
    folder = write_pictures(tmp_path / "pictures", lit, suffix)
    (folder / "notes.txt").write_text("x")
    (folder / ".hidden.png").write_bytes(b"")
    run(folder, tmp_path / "S")
    session = Session.open(tmp_path / "S")
    assert session.status == "complete"
    assert [r.source for r in session.frames] == [f"IMG_{k}{suffix}" for k in range(COUNT)]
    assert [r.flash for r in session.frames] == lit
    assert all(r.usable and r.confidence > 0.99 for r in session.frames)
    for record in session.frames:
        assert (session.path / record.file).read_bytes() == (folder / record.source).read_bytes()
    assert not session.scene_dir.exists()
    assert session.info["source"] == {"kind": "pictures", "path": str(folder)}
    assert session.info["tagging"]["separation"] > 5


def test_a_flash_list_goes_before_what_the_pictures_show(tmp_path, lit):
    folder = write_pictures(tmp_path / "pictures", lit)
    (tmp_path / "lit.txt").write_text("IMG_0\nIMG_3\n")
    session = run(folder, tmp_path / "S", flash_list=tmp_path / "lit.txt")
    assert [r.index for r in session.frames if r.flash == 1] == [0, 3]
    assert "tagging" not in session.info


@pytest.mark.parametrize("flash", [0, 1])
def test_pictures_that_are_all_of_one_kind_need_a_flash_list(tmp_path, flash):
    folder = write_pictures(tmp_path / "pictures", [flash] * COUNT)
    with pytest.raises(TaggingError, match="flash list"):
        run(folder, tmp_path / "S")
    assert not (tmp_path / "S").exists()


def test_one_picture_alone_needs_a_flash_list(tmp_path):
    folder = write_pictures(tmp_path / "pictures", [0])
    with pytest.raises(TaggingError, match="of 1 picture cannot be told"):
        run(folder, tmp_path / "S")
    (tmp_path / "lit.txt").write_text("0, 1\n")
    assert run(folder, tmp_path / "S", flash_list=tmp_path / "lit.txt").frames[0].flash == 1


@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (
            lambda f: write_png(f / "IMG_5.png", np.zeros((9, 9, 3), np.uint8)),
            {},
            "IMG_5.png is 9 x 9 pixels",
        ),
        (lambda f: (f / "IMG_5.png").write_bytes(b"x"), {}, "IMG_5.png"),
        (lambda f: (f / "IMG_0.png").write_bytes(b""), {}, "IMG_0.png"),
        (
            lambda f: write_jpeg(f / "IMG_5.jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8)),
            {},
            "both IMG_5.jpg and IMG_5.png|both IMG_5.png and IMG_5.jpg",
        ),
        (lambda f: None, {"points": "cloud.ply"}, "cannot be placed"),
        (lambda f: None, {"poses": "mine.json"}, "as cameras.json"),
        (lambda f: None, {"masks": "nowhere"}, "no folder of masks"),
    ],
)
def test_what_does_not_fit_is_said_before_anything_is_written(tmp_path, lit, damage, options, words):
    folder = write_pictures(tmp_path / "pictures", lit)
    damage(folder)
    with pytest.raises(SourceError, match=words):
        run(folder, tmp_path / "S", **{name: tmp_path / file for name, file in options.items()})
    assert not (tmp_path / "S").exists()


@pytest.fixture
def posed_pictures(tmp_path, lit, cameras):
    """A posed set of the lit pictures, with masks, a cloud, a flash position and a validation frame."""
    folder = write_pictures(tmp_path / "posed", lit)
    frames = []
    for k, flash in enumerate(lit):
        write_png(folder / f"mask_{k}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
        pose = cameras[k % len(cameras)].cam_from_world
        frames.append(
            {
                "index": k,
                "file": f"IMG_{k}.png",
                "mask": f"mask_{k}.png",
                "flash": 1 - flash,  # wrong on purpose: shows which of the two was taken
                "split": "val" if k == 3 else "train",
                "cam_from_world": pose.tolist(),
            }
        )
    K = [[50, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]
    shared = {"width": WIDTH, "height": HEIGHT, "K": K, "flash": {"offset_cam": [0.01, 0, 0]}}
    (folder / "cameras.json").write_text(json.dumps(shared | {"frames": frames}))
    vertices = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (folder / "points.ply").write_text(f"ply\nformat ascii 1.0\n{vertices}end_header\n0 0 0\n")
    return folder


def parts_of(session):
    return {
        "poses": session.cameras_dir.is_dir(),
        "points": session.points_path.is_file(),
        "masks": session.masks_dir.is_dir(),
    }


def test_what_a_posed_set_brings_can_be_left_out(posed_pictures, lit, tmp_path):
    everything = parts_of(run(posed_pictures, tmp_path / "all"))
    assert everything == {"poses": True, "points": True, "masks": True}
    for part in ("points", "masks"):
        session = run(posed_pictures, tmp_path / part, without=frozenset({part}))
        assert parts_of(session) == everything | {part: False}
        assert session.info["source"]["units"] == "metres"
    session = run(posed_pictures, tmp_path / "poses", without=frozenset({"poses"}))
    assert parts_of(session) == {"poses": False, "points": False, "masks": True}
    assert "points were left out" in session.info["warnings"][0]
    assert "units" not in session.info["source"]
    assert [r.flash for r in session.frames] == [1 - flash for flash in lit]  # as the set says
    session = run(posed_pictures, tmp_path / "flash", without=frozenset({"flash"}))
    assert parts_of(session) == everything
    assert [r.flash for r in session.frames] == lit  # as the pictures show


def test_validation_frames_stay_and_stay_marked(posed_pictures, tmp_path):
    session = run(posed_pictures, tmp_path / "S", without=frozenset({"poses", "points", "masks", "flash"}))
    assert [r.index for r in session.frames if r.split == "val"] == [3]
    assert len(session.frames) == COUNT
    assert session.info["source"]["without"] == ["flash", "masks", "points", "poses"]


def test_a_part_that_no_source_brings_is_refused(posed_pictures, tmp_path):
    with pytest.raises(ValueError, match="'hair'; known are poses"):
        ImportOptions(without=frozenset({"hair"}))
    (tmp_path / "film.mp4").write_bytes(b"x")
    with pytest.raises(SourceError, match="--without is for image sets"):
        run(tmp_path / "film.mp4", tmp_path / "S", without=frozenset({"poses"}))


def calibration(**entries):
    return json.dumps({"schema": "relight-calibration", "version": 1, **entries})


OFFSET = {"value": [0.02, 0.01, 0.0], "unit": "m", "sigma": 0.001, "source": "a ruler"}
AXIS = {"value": [0.0, 0.0, 1.0], "unit": "1", "sigma": None, "source": "a wall"}


def test_a_given_calibration_goes_before_the_source_and_the_source_fills_its_gaps(posed_pictures, tmp_path):
    (tmp_path / "c.json").write_text(calibration(flash_axis=AXIS))
    session = run(posed_pictures, tmp_path / "S", calibration=tmp_path / "c.json")
    found = json.loads(session.calibration_path.read_text())
    assert found["flash_axis"] == AXIS
    assert found["flash_offset_cam_m"]["value"] == [0.01, 0.0, 0.0]
    (tmp_path / "c.json").write_text(calibration(flash_offset_cam_m=OFFSET))
    session = run(posed_pictures, tmp_path / "T", calibration=tmp_path / "c.json")
    assert json.loads(session.calibration_path.read_text())["flash_offset_cam_m"] == OFFSET


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "x",
        '{"schema": "relight-calibration", "version": 99}',
        calibration(flash_axis=AXIS | {"value": ["a"]}),
        calibration(flash_axis=AXIS | {"sigma": -1}),
        calibration(flash_axis=AXIS | {"unit": None}),
        calibration(intrinsics={"pinhole": AXIS | {"value": [[1, 2], [3]]}}),
    ],
)
def test_a_calibration_that_cannot_be_is_refused_before_the_import(posed_pictures, tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(CalibrationError, match=r"c\.json"):
        run(posed_pictures, tmp_path / "S", calibration=tmp_path / "c.json")
    assert not (tmp_path / "S").exists()


def test_the_command_line_has_all_of_this(posed_pictures, lit, tmp_path, capsys):
    folder = write_pictures(tmp_path / "pictures", lit)
    (tmp_path / "c.json").write_text(calibration(flash_offset_cam_m=OFFSET))
    argv = ["import", str(folder), "--out", str(tmp_path / "P"), "--calibration", str(tmp_path / "c.json")]
    assert main(argv) == 0
    said = capsys.readouterr().out
    assert f"{sum(lit)} lit, {COUNT - sum(lit)} unlit" in said
    assert "poses     no" in said
    argv = ["import", str(posed_pictures), "--out", str(tmp_path / "Q"), "--without", "poses, points,flash"]
    assert main(argv) == 0
    assert "poses     no" in capsys.readouterr().out
    assert main([*argv[:-1], "poses,hair"]) == 2
    assert "'hair' is not one of poses, points, masks, flash" in capsys.readouterr().err
    dark = write_pictures(tmp_path / "dark", [0] * COUNT)
    assert main(["import", str(dark), "--out", str(tmp_path / "R")]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("relight: No flash that goes on and off")
