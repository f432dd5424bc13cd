"""The whole way on the simulated rig, by the commands that a user types."""

import json
from dataclasses import replace

import av
import numpy as np
import pytest

from capture.cameras import load_posed_set
from capture.images import read_exr, read_image
from capture.ply import read_ply
from capture.session import Session
from capture.sim import RigConfig, simulate_video
from relight.cli import main

# A coarse head in small pictures; four pulses, from four sides.
CONFIG = replace(RigConfig.small(), path=replace(RigConfig.small().path, duration_s=4.2), cloud_points=12_000)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Folder with the film of a head, its poses, its cloud and the truth."""
    folder = tmp_path_factory.mktemp("film")
    simulate_video(folder, CONFIG)
    return folder


@pytest.fixture(scope="module")
def session(film, tmp_path_factory):
    """The session of that film, with the portrait "solve"."""
    path = tmp_path_factory.mktemp("work") / "S"
    (video,) = film.glob("VID_*.mp4")
    known = ["--poses", str(film / "cameras.json"), "--points", str(film / "points.ply")]
    assert main(["import", str(video), *known, "--out", str(path)]) == 0
    assert main(["fit", str(path), "--device", "cpu"]) == 0
    return path


def test_the_film_is_tagged_as_it_was_lit(film, session):
    truth = [json.loads(line) for line in (film / "truth.jsonl").read_text().splitlines()]
    frames = Session.open(session).frames
    assert len(frames) == len(truth)
    known = [(frame, real) for frame, real in zip(frames, truth, strict=True) if frame.flash is not None]
    assert all(frame.flash == real["flash"] for frame, real in known)
    # Frames at the edge of a pulse may honestly be left open; most of the fully lit ones must be found.
    lit = sum(real["flash"] == 1 for real in truth)
    assert sum(frame.flash == 1 and frame.usable for frame in frames) >= lit / 2 > 0


def test_the_portrait_has_everything_that_belongs_to_it(session):
    folder = session / "portraits" / "solve"
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert {
        "portrait.safetensors",
        "portrait.json",
        "config.json",
        "plan.json",
        "metrics.json",
        "report.html",
        "previews/previews.json",
        "previews/orbit.jpg",
    } <= files
    metrics = json.loads((folder / "metrics.json").read_text())
    stages = {"plan", "read", "cloud", "observe", "solve", "check", "face", "save", "previews"}
    assert set(metrics["seconds"]) == stages
    assert metrics["points"] > 1000
    assert metrics["frames"] == len(json.loads((folder / "plan.json").read_text())["frames"])


def test_the_portrait_is_like_the_sitter(film, session, tmp_path):
    measures = tmp_path / "measures.json"
    assert main(["evaluate", str(session), "--truth", str(film), "--json", str(measures)]) == 0
    result = json.loads(measures.read_text())
    assert result["views"] == CONFIG.validation_views
    # At 128 x 160 pixels and 12,000 points the fit is coarse; a flat grey head, or one that faces the
    # wrong way, is far outside of these.
    assert result["captured"]["psnr_db"] > 20
    assert result["mask"]["iou"] > 0.9
    assert result["normals"]["median_deg"] < 15
    assert result["albedo"]["psnr_db"] > 15
    assert "Measured against the truth" in (session / "portraits/solve/report.html").read_text()


def test_views_and_lights_become_the_files_that_other_tools_read(film, session, tmp_path):
    out = tmp_path / "pictures"
    argv = ["render", str(session), "--cameras", str(film / "cameras_val.json")]
    argv += ["--lights", str(film / "lights.json"), "--maps", "--out", str(out)]
    assert main(argv) == 0
    lights = [light["name"] for light in json.loads((film / "lights.json").read_text())["lights"]]
    names = [frame.camera.name for frame in load_posed_set(film / "cameras_val.json").frames]
    maps = ["albedo", "normal", "shading", "mask", "depth"]
    maps += ["albedo_sigma", "normal_sigma", "unobserved_flash", "unobserved_view"]
    expected = {f"{name}.{layer}.exr" for name in names for layer in maps + lights}
    expected |= {f"{name}.{light}.png" for name in names for light in lights}
    assert {path.name for path in out.iterdir()} == expected
    mask = read_exr(out / f"{names[0]}.mask.exr")
    normal = read_exr(out / f"{names[0]}.normal.exr")
    assert mask.shape == (CONFIG.height, CONFIG.width)
    assert 0 <= mask.min() < 0.1 < 0.9 < mask.max() <= 1
    # Half floats resolve a unit vector to 2^-11.
    np.testing.assert_allclose(np.linalg.norm(normal[mask > 0.9], axis=1), 1.0, atol=2e-3)
    picture = read_image(out / f"{names[0]}.dir1.png")
    assert picture[mask > 0.9].mean() > 40
    assert picture[mask == 0].max() == 0


def test_an_orbit_is_a_video_that_moves(session, tmp_path):
    video = tmp_path / "orbit.mp4"
    argv = ["render", str(session), "--orbit", "--seconds", "0.5", "--light", "room", "--out", str(video)]
    assert main(argv) == 0
    with av.open(str(video)) as container:
        pictures = [frame.to_ndarray(format="gray").astype(float) for frame in container.decode(video=0)]
    assert len(pictures) == 15
    assert np.abs(pictures[0] - pictures[7]).mean() > 1


def test_a_second_portrait_stands_beside_the_first_and_is_the_one_that_counts(session, tmp_path, capsys):
    assert main(["fit", str(session), "--name", "short", "--max-seconds", "0.01", "--device", "cpu"]) == 0
    capsys.readouterr()
    assert main(["report", str(session)]) == 0
    assert capsys.readouterr().out.strip().endswith("short/report.html")
    plan = json.loads((session / "portraits/short/plan.json").read_text())
    assert "no_time" in plan["left_out"].values()
    assert (session / "portraits/solve/portrait.json").is_file()


def test_the_simulated_rig_is_a_device_to_record_from(tmp_path, capsys):
    from capture.cli import main as capture

    path = tmp_path / "S"
    argv = ["--camera", "sim:coarse", "--flash", "sim:", "--duration", "3.2", "--out", str(path)]
    assert capture(argv) == 0
    session = Session.open(path)
    assert session.status == "complete"
    lit = [frame for frame in session.frames if frame.flash == 1 and frame.usable]
    assert len(lit) >= 3
    assert {file.name for file in (path / "frames").iterdir()} == {
        frame.file.removeprefix("frames/") for frame in session.frames if frame.file
    }
    assert set(session.load_scene_cameras()) == {frame.index for frame in session.frames if frame.file}
    assert len(read_ply(session.points_path).points) > 1000
    assert main(["plan", str(path)]) == 0
