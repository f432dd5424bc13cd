"""A folder of RAW pairs becomes a session: linear, in order, tagged, with what is clipped known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from capture.cameras import Camera
from capture.errors import SourceError, TaggingError
from capture.images import write_jpeg, write_png
from capture.importers import ImportOptions, import_source
from capture.raw.reader import read_raw
from capture.session import Session
from capture.sim import Rig, RigConfig
from relight.cli import main
from relight.scene import load_scene

WHITE, BLACK = 4095, ((60.0, 62.5), (64.25, 70.0))
NEUTRAL = np.array([0.5, 1.0, 0.625])  # the camera's answer to white: its white balance is 2, 1, 1.6
FULL_WELL_E, READ_NOISE_E = 6000.0, 3.0
COUNT, HEIGHT, WIDTH = 12, 64, 96
LIT = [k % 2 for k in range(COUNT)]
HALF = 2.0**-11  # relative rounding of a half float


def shading(height, width):
    grid = np.array([[2.5, 1.6, 2.2], [1.4, 1.0, 1.3], [2.1, 1.5, 2.4]])
    y, x = (2 * (np.arange(n) + 0.5) / n for n in (height, width))
    tents = [np.maximum(0, 1 - np.abs(at[:, None] - np.arange(3))) for at in (y, x)]
    return tents[0] @ grid @ tents[1].T, grid


def camera_file(make, radiance, rng=None, shaded=False, factor=1.0, **tags):
    """A DNG of balanced radiance [H, W, 3]; and the standard deviation of each sample's, [H, W]."""
    height, width = radiance.shape[:2]
    gain, grid = shading(height, width) if shaded else (np.ones((height, width)), None)
    light = make.mosaic_of(radiance * NEUTRAL) / gain * factor
    sigma = np.zeros_like(light)
    if rng is not None:
        sigma = np.sqrt(np.maximum(light, 0) / FULL_WELL_E + (READ_NOISE_E / FULL_WELL_E) ** 2)
        light = light + sigma * rng.normal(size=light.shape)
    if shaded:
        maps = [make.gain_map(grid, (y, x, height, width), pitch=(2, 2)) for y in (0, 1) for x in (0, 1)]
        tags["opcodes2"] = make.opcode_list(*maps)
    code = 1 / (WHITE - 70)
    sigma = (
        np.sqrt(sigma**2 + code**2 / 12) * gain / factor / make.mosaic_of(np.ones_like(radiance) * NEUTRAL)
    )
    codes = make.codes_of(light, BLACK, WHITE)
    return make.dng(codes, black=BLACK, white=WHITE, neutral=NEUTRAL, **tags), sigma


def pictures(lit=LIT):
    """[K, H, W, 3] balanced radiance of a near disc and a far wall; the flash adds to the disc most."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    near = np.hypot((x - WIDTH / 2) / WIDTH, (y - HEIGHT / 2) / HEIGHT) < 0.3
    texture = np.random.default_rng(5).uniform(0.05, 0.15, (HEIGHT, WIDTH, 1)) * np.array([1.0, 0.8, 0.7])
    gain = np.where(near, 1.5, 0.2)[..., None]
    return np.array(
        [
            texture * level * (1 + gain * flash)
            for level, flash in zip(np.linspace(0.95, 1.05, len(lit)), lit, strict=True)
        ]
    )


def stamp(k):
    return f"2026:05:01 12:{k // 60:02d}:{k % 60:02d}"


@pytest.fixture
def folder(make, tmp_path):
    """Twelve pictures, every second one lit, with numbers that went back to one on the way."""
    folder = tmp_path / "card"
    folder.mkdir()
    rng = np.random.default_rng(1)
    for k, radiance in enumerate(pictures()):
        data, _ = camera_file(make, radiance, rng, time=stamp(k), exposure_s=0.01, iso=200)
        (folder / name_of(k)).write_bytes(data)
    return folder


def name_of(k):
    return f"DSC_{(k + 4) % COUNT + 1}.dng"


def run(source, out, **options):
    return import_source([source], out, ImportOptions(**options))


def test_pairs_are_taken_in_the_order_of_their_times_and_tagged(folder, tmp_path):
    run(folder, tmp_path / "S")
    session = Session.open(tmp_path / "S")
    assert session.status == "complete"
    assert [record.source for record in session.frames] == [name_of(k) for k in range(COUNT)]
    assert [record.flash for record in session.frames] == LIT
    assert all(record.usable and record.confidence > 0.99 for record in session.frames)
    assert [record.pts_s for record in session.frames] == list(range(COUNT))
    assert session.frames[0].exposure_s == pytest.approx(0.01, rel=1e-5)
    assert session.frames[0].gain == 2.0
    assert session.info["source"] == {"kind": "raw", "path": str(folder)}
    assert session.info["device"] == {"camera": "Maker Model 1"}
    assert session.info["warnings"] == []
    raw = session.info["raw"]
    assert raw["white_balance"] == pytest.approx([2.0, 1.0, 1.6], rel=1e-5)
    assert raw["cfa"] == "RGGB"
    assert len(raw["camera_from_xyz"]) == 9
    assert raw["radiance_factors"] is None


def test_radiance_is_that_of_the_reader_with_one_white_balance(folder, tmp_path):
    session = run(folder, tmp_path / "S")
    balance = session.info["raw"]["white_balance"]
    assert session.info["image"]["clip_radiance"] == 2.0
    for record in session.frames[:3]:
        picture = read_raw(folder / record.source, balance)
        assert not picture.clipped.any()
        # 6e-8 is the smallest step of a half float
        np.testing.assert_allclose(session.load_radiance(record), picture.radiance, rtol=HALF, atol=6e-8)


def test_numbers_decide_where_no_time_is_known(make, folder, tmp_path):
    for k, radiance in enumerate(pictures()):
        data, _ = camera_file(make, radiance, time="0000:00:00 00:00:00")
        (folder / f"DSC_{k + 1}.dng").write_bytes(data)
    session = run(folder, tmp_path / "S")
    assert [record.source for record in session.frames] == [f"DSC_{k + 1}.dng" for k in range(COUNT)]
    assert all(record.pts_s is None for record in session.frames)
    assert "The order is that of the names" in session.info["warnings"][0]


def test_twins_and_strays_are_left_out_by_name(folder, tmp_path):
    for name in ("DSC_1.JPG", "dsc_2.jpg", "selfie.jpg"):
        write_jpeg(folder / name, np.zeros((8, 8, 3), np.uint8))
    (folder / ".hidden.jpg").write_bytes(b"")
    session = run(folder, tmp_path / "S")
    assert len(session.frames) == COUNT
    assert session.info["warnings"] == [
        "The RAW files were taken, not their twins DSC_1.JPG, dsc_2.jpg.",
        "Pictures without a RAW file were left out: selfie.jpg.",
    ]


def test_other_exposures_are_brought_to_the_usual_one_and_said(make, folder, tmp_path):
    truth = pictures()
    for k in (1, 4, 7):  # half the exposure at double the f-number and four times the sensitivity: halved
        data, _ = camera_file(
            make, truth[k], factor=0.5, time=stamp(k), exposure_s=0.005, iso=800, aperture=4.0
        )
        (folder / name_of(k)).write_bytes(data)
    session = run(folder, tmp_path / "S")
    (sentence,) = session.info["warnings"]
    assert "The exposure changes" in sentence
    assert name_of(4) in sentence
    factors = session.info["raw"]["radiance_factors"]
    assert factors == pytest.approx([2.0 if k in (1, 4, 7) else 1.0 for k in range(COUNT)], rel=1e-5)
    assert [record.flash for record in session.frames] == LIT
    assert session.info["image"]["clip_radiance"] == 4.0
    levels = [session.load_radiance(record).mean() for record in session.frames]
    assert levels == pytest.approx(truth.mean(axis=(1, 2, 3)), rel=0.01)  # of noise, codes and demosaicing


def test_clipped_pixels_are_no_observations_and_bright_ones_are(make, tmp_path):
    folder = tmp_path / "card"
    folder.mkdir()
    truth = pictures()
    truth[:, 20:24, 40:44] = 5.0  # clips in all colours
    truth[:, 2, 2] = [1.4, 1.2, 1.3]  # in the shaded corner: over 1, and below the clip of its samples
    for k, radiance in enumerate(truth):
        (folder / name_of(k)).write_bytes(camera_file(make, radiance, shaded=True, time=stamp(k))[0])
    session = run(folder, tmp_path / "S")
    limit = session.info["image"]["clip_radiance"]
    assert limit == 8.0  # the power of two from 2 (white balance) x 2.5 (shading) on
    radiance = session.load_radiance(session.frames[0])
    picture = read_raw(folder / name_of(0), session.info["raw"]["white_balance"])
    assert np.array_equal((radiance >= limit).all(axis=2), picture.clipped)
    assert (radiance[~picture.clipped] < limit).all()
    assert radiance[2, 2].max() > 1.1


def test_a_scene_gives_no_weight_to_clipped_pixels_of_raw_frames(make, tmp_path):
    folder = tmp_path / "card"
    folder.mkdir()
    truth = pictures()
    truth[:, 20:24, 40:44] = 5.0
    for k, radiance in enumerate(truth):
        (folder / name_of(k)).write_bytes(camera_file(make, radiance, time=stamp(k))[0])
    session = run(folder, tmp_path / "S")
    K = np.array([[90.0, 0, WIDTH / 2], [0, 90.0, HEIGHT / 2], [0, 0, 1]])
    camera = Camera("still", WIDTH, HEIGHT, K, np.eye(4))
    session.save_scene_cameras(dict.fromkeys(range(COUNT), camera))
    session.points_path.parent.mkdir(exist_ok=True)
    vertices = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    session.points_path.write_text(f"ply\nformat ascii 1.0\n{vertices}end_header\n0 0 1\n")
    scene = load_scene(Session.open(tmp_path / "S"), frames=[0, 1])
    observation = scene.observe(scene.views[0])
    clipped = read_raw(folder / name_of(0)).clipped
    assert clipped.any()
    assert np.array_equal(observation.valid.numpy() == 0, clipped)


@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (lambda f, make: (f / "DSC_3.dng").write_bytes(b"x"), {}, "DSC_3.dng cannot be read as RAW"),
        (lambda f, make: (f / "DSC_3.nef").write_bytes(b"x"), {}, "both DSC_3.dng and DSC_3.nef"),
        (
            lambda f, make: (f / "DSC_3.dng").write_bytes(make.dng(np.full((32, 32), 900))),
            {},
            "32 x 32 pixels",
        ),
        (
            lambda f, make: (f / "DSC_3.dng").write_bytes(
                make.dng(np.full((HEIGHT, WIDTH), 900), camera=("Other", "Thing"))
            ),
            {},
            "is of Other Thing",
        ),
        (lambda f, make: None, {"transfer": "srgb"}, "leave --transfer out"),
        (lambda f, make: None, {"poses": "poses.json"}, "as cameras.json"),
        (lambda f, make: None, {"points": "cloud.ply"}, "cannot be placed"),
        (lambda f, make: None, {"masks": "nowhere"}, "no folder of masks"),
    ],
)
def test_what_does_not_fit_is_said_before_anything_is_written(make, folder, tmp_path, damage, options, words):
    damage(folder, make)
    paths = {name: value if name == "transfer" else tmp_path / value for name, value in options.items()}
    with pytest.raises(SourceError, match=words):
        run(folder, tmp_path / "S", **paths)
    assert not (tmp_path / "S").exists()


def test_a_flash_list_and_masks_go_by_the_names_of_the_raw_files(folder, tmp_path):
    (tmp_path / "lit.txt").write_text("DSC_5\nDSC_7\n")
    (tmp_path / "masks").mkdir()
    for k in range(COUNT):
        write_png(tmp_path / "masks" / f"DSC_{k + 1}.png", np.full((HEIGHT, WIDTH), k, np.uint8))
    session = run(folder, tmp_path / "S", flash_list=tmp_path / "lit.txt", masks=tmp_path / "masks")
    assert [record.source for record in session.frames if record.flash == 1] == ["DSC_5.dng", "DSC_7.dng"]
    assert "tagging" not in session.info
    assert session.load_mask(session.frames[0])[0, 0] == 4


def test_an_import_that_was_cut_off_is_completed(folder, tmp_path):
    whole = run(folder, tmp_path / "whole")
    written = []

    def power_cut(stage, share):
        written.append(stage)
        if written.count("developing RAW files") == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_source([folder], tmp_path / "S", ImportOptions(), power_cut)
    assert len(Session.open(tmp_path / "S").frames) == 5
    run(folder, tmp_path / "S")
    again = Session.open(tmp_path / "S")
    assert again.status == "complete"
    assert again.frames == whole.frames
    assert again.info["image"] == whole.info["image"]


def test_pictures_that_are_all_lit_need_a_flash_list(make, tmp_path):
    folder = tmp_path / "card"
    folder.mkdir()
    for k, radiance in enumerate(pictures([1] * COUNT)):
        (folder / name_of(k)).write_bytes(camera_file(make, radiance, np.random.default_rng(k))[0])
    with pytest.raises(TaggingError, match="flash list"):
        run(folder, tmp_path / "S")
    assert not (tmp_path / "S").exists()


def test_turned_cameras_are_shown_as_most_pictures_are(make, folder, tmp_path):
    for k, radiance in enumerate(pictures()):
        data, _ = camera_file(make, radiance, time=stamp(k), orientation=6 if k else 1)
        (folder / name_of(k)).write_bytes(data)
    session = run(folder, tmp_path / "S")
    assert session.info["image"]["rotation_deg"] == 90
    assert (session.info["image"]["width"], session.info["image"]["height"]) == (WIDTH, HEIGHT)
    assert "The camera was turned" in session.info["warnings"][0]


@pytest.fixture(scope="module")
def rig():
    """As coarse a head as there is: only its light matters here."""
    coarse = replace(RigConfig.small(), cell_mm=9.0, strands=60, shadow_directions=6, cloud_points=500)
    return Rig.build(coarse)


def test_simulated_pairs_are_tagged_measured_and_can_be_planned(make, rig, tmp_path, capsys):
    folder = tmp_path / "card"
    folder.mkdir()
    rng = np.random.default_rng(3)
    truth, sigmas = [], []
    lit = [(k // 2 + k) % 2 for k in range(16)]  # pairs, the lit one now first, now last
    for k, flash in enumerate(lit):
        camera = rig.camera(1.7 * (k + 0.5) / len(lit), "still", flash=flash)
        layers = rig.layers(camera, bool(flash))
        radiance = layers.room + (layers.flash if flash else 0)
        data, sigma = camera_file(make, radiance, rng, shaded=True, time=stamp(k), subsec=f"{k:02d}")
        (folder / f"_DSF{k:04d}.dng").write_bytes(data)
        truth.append(radiance)
        sigmas.append(sigma)
    assert main(["import", str(folder), "--out", str(tmp_path / "S")]) == 0
    assert "8 lit, 8 unlit" in capsys.readouterr().out
    session = Session.open(tmp_path / "S")
    assert [record.flash for record in session.frames] == lit
    errors = []
    for record, radiance, sigma in zip(session.frames, truth, sigmas, strict=True):
        found = session.load_radiance(record)
        valid = (found < session.info["image"]["clip_radiance"]).all(axis=2)
        residual = make.mosaic_of(found - radiance) / sigma
        errors.append(residual[valid])
    errors = np.concatenate(errors)
    assert len(errors) > 150_000
    # What the noise predicts: mean 0 to 4 / sqrt(n), spread 1 to 1 % (rounding to halves adds less).
    assert abs(errors.mean()) < 4 / np.sqrt(len(errors)) + 0.01
    assert errors.std() == pytest.approx(1.0, abs=0.01)
    plan = tmp_path / "plan.json"
    assert main(["plan", str(tmp_path / "S"), "--json", str(plan)]) == 0
    assert json.loads(plan.read_text())
