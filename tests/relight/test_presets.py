"""A preset's refinement follows the solve, gets what it needs, and its portrait is what is saved."""

import json

import numpy as np
import pytest
from analytic_scene import Head, arc, cloud_of, looking_at, photograph, write_session

from capture.cameras import PosedFrame, PosedSet, save_posed_set
from capture.images import read_exr, write_exr, write_png
from capture.ply import PointCloud
from relight.cli import main
from relight.decoder import KINDS
from relight.errors import PlanError
from relight.fit import fit
from relight.plan import Action
from relight.portrait import load_portrait
from relight.presets import PRESETS, Preset, chosen_preset

NO_FACE = {"face_prior": Action.SKIP}  # a second less a fit
PLAIN = Preset("plain_decoder:refine", "plain_decoder:PlainConfig")


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session as small as can be solved, so that many fits of it take little time."""
    head = Head()
    frames = [photograph(head, camera) for camera in arc(count=18, size=48)]
    points, normals = cloud_of(head, 1500, 0.0004)
    path = tmp_path_factory.mktemp("fit") / "S"
    return write_session(path, frames, PointCloud(points, normals)).path


@pytest.fixture(autouse=True)
def plain_preset(monkeypatch):
    monkeypatch.setitem(KINDS, "plain", "plain_decoder:PlainDecoder")
    monkeypatch.setitem(PRESETS, "plain", PLAIN)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_loaded(name):
    preset = chosen_preset(name)
    assert (preset.load_refine() is None) == (preset.refine is None)
    assert (preset.config({}) is None) == (preset.make_config is None)


def test_an_unknown_setting_is_refused_with_those_that_there_are():
    assert PLAIN.config({"factor": 0.5}).factor == 0.5
    with pytest.raises(PlanError, match=r"no setting 'steps'; it has factor\."):
        PLAIN.config({"steps": 1})
    with pytest.raises(PlanError, match="it has none"):
        Preset().config({"steps": 1})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", "many"),
        ("steps", 2.5),
        ("steps", True),
        ("patch", None),
        ("rate", "high"),
        ("rate", float("nan")),
        ("rate", False),
        ("exposures", "off"),
        ("exposures", 1),
        ("precision", 3),
        ("widths", 16),
        ("widths", [16, "wide"]),
    ],
)
def test_a_setting_of_another_kind_is_refused_with_the_usual_one(name, value):
    with pytest.raises(PlanError, match=f"{name}.*usual is"):
        PRESETS["fast"].config({name: value})


def test_settings_as_json_has_them_are_taken():
    config = PRESETS["fast"].config({"widths": [16, 24], "rate": 1, "patch": 64})
    assert (list(config.widths), config.rate, config.patch) == ([16, 24], 1, 64)


def test_the_refined_portrait_is_saved_with_its_decoder_and_settings(session):
    folder = fit(session, "plain", device="cpu", max_seconds=1e6, settings={"factor": 0.5}, seed=7)
    portrait = load_portrait(folder)
    assert portrait.decoder.factor == 0.5
    assert portrait.info["seed"] == 7
    # Of the limit, what the solve took and what is kept for pictures and report is gone.
    assert 0.99e6 < portrait.info["seconds"] < 1e6
    config = json.loads((folder / "config.json").read_text())
    assert config["refinement"] == {"factor": 0.5}
    assert config["seed"] == 7
    metrics = json.loads((folder / "metrics.json").read_text())
    assert "Refined." in metrics["warnings"]
    assert "refine" in metrics["seconds"]
    # Half the albedo under the flash: the solve's own pictures were better, and that is said.
    assert any("the photometric solve at" in sentence for sentence in metrics["warnings"])


def test_a_second_fit_goes_on_from_the_checkpoint_unless_the_seed_is_another(session):
    runs = []
    for settings, seed, fresh in [
        ({}, 1, False),
        ({}, 1, False),  # nothing has changed: kept
        ({"factor": 0.25}, 1, False),  # runs again, on the same checkpoint
        ({"factor": 0.25}, 2, False),
        ({"factor": 0.25}, 2, True),
    ]:
        folder = fit(
            session,
            "plain",
            device="cpu",
            name="again",
            forced=NO_FACE,
            settings=settings,
            seed=seed,
            fresh=fresh,
        )
        runs.append(load_portrait(folder).info["runs"])
    assert runs == [1, 1, 2, 1, 1]


def test_without_time_left_a_refinement_is_asked_for_the_best_it_has(session):
    folder = fit(session, "plain", device="cpu", name="short", max_seconds=0.01, forced=NO_FACE)
    assert load_portrait(folder).info["seconds"] == 0.0


def test_the_papers_preset_goes_from_a_session_to_a_report_and_on_from_its_checkpoint(session):
    settings = {"crop": 32, "steps": 2, "baked_views": 2}
    folder = fit(session, "paper", device="cpu", settings=settings)
    assert load_portrait(folder).decoder.kind == "paper"
    assert (folder / "report.html").is_file()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["solve"]["refinement"]["steps"] == 2
    assert any("VGG-16" in sentence for sentence in metrics["warnings"])
    fit(session, "paper", device="cpu", settings=settings | {"steps": 4})
    assert load_portrait(folder).info["refinement"]["held_out_db"][-1][0] == 4
    assert len(list((folder / "checkpoint").glob("*.safetensors"))) == 1


@pytest.fixture
def truth(tmp_path):
    """A view of the head that is not among the frames, with what a perfect portrait gives there."""
    camera = looking_at(np.array([0.12, 0.08, 0.48]), np.zeros(3), "0100", size=64, flash=0)
    frame = photograph(Head(), camera)
    for name in ("mask", "linear", "gt"):
        (tmp_path / name).mkdir()
    write_png(tmp_path / "mask" / "0100.png", frame.hit.astype(np.uint8) * 255)
    write_exr(tmp_path / "linear" / "0100.exr", frame.radiance.astype(np.float32))
    write_exr(tmp_path / "gt" / "albedo_0100.exr", frame.albedo.astype(np.float32))
    write_exr(tmp_path / "gt" / "normal_0100.exr", frame.normals.astype(np.float32))
    posed = PosedFrame(camera, 100, flash=0, split="val")
    save_posed_set(PosedSet("head", (posed,), "srgb", None, tmp_path), tmp_path / "cameras.json")
    return tmp_path


def test_fast_goes_by_its_commands_from_a_session_to_a_report_pictures_and_measures(session, truth, tmp_path):
    few = ["--steps", "20", "--set", "patch=32", "--set", "check_every=10"]
    assert main(["fit", str(session), "--preset", "fast", "--device", "cpu", *few]) == 0
    folder = session / "portraits" / "fast"
    portrait = load_portrait(folder)
    assert portrait.decoder.kind == "refined"
    facts = json.loads((folder / "metrics.json").read_text())["solve"]["refinement"]
    assert facts["steps"] == 20
    assert [step for step, _ in facts["held_out_loss"]] == [0, 10, 20]
    assert facts["held_out_loss"][-1][1] < facts["held_out_loss"][0][1]
    config = json.loads((folder / "config.json").read_text())
    assert config["solve"]["room_gloss"]
    assert config["solve"]["shape"] is not None
    assert config["refinement"]["steps"] == 20

    here = [str(session), "--portrait", "fast"]
    assert main(["report", *here]) == 0
    assert (folder / "report.html").is_file()
    pictures = tmp_path / "pictures"
    cameras = str(truth / "cameras.json")
    lights = ["--light", "captured", "--light", "directional:0.5,0.5,0.7;ambient=0.3"]
    assert main(["render", *here, *lights, "--cameras", cameras, "--out", str(pictures)]) == 0
    measures = tmp_path / "measures.json"
    assert main(["evaluate", *here, "--truth", str(truth), "--json", str(measures)]) == 0
    result = json.loads(measures.read_text())
    # 48 pixels across and 1500 points; a network that has gone astray would be far outside.
    assert result["captured"]["psnr_db"] > 28
    assert result["mask"]["iou"] > 0.95
    assert result["normals"]["median_deg"] < 5
    shown = [read_exr(path) for path in sorted(pictures.rglob("*.exr"))]
    assert shown
    assert all(np.isfinite(picture).all() for picture in shown)
