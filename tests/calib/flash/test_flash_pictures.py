"""From pictures of a board lit by a near flash to a calibration.json, on a simulator that shares no formula.

Each pixel is the mean of 2 x 2 rays through the lens that meet the board's plane; the light there is written
out in plain vectors; then come blur, shot and read noise, and eight bits of sRGB.
"""

import json
import re
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from calib.board.charuco import Board, save_board
from calib.board.detection import BoardDetector, Problem
from calib.calibration import Calibration, Intrinsics, Quantity, load_calibration, save_calibration
from calib.errors import FlashGeometryError
from calib.flash.boards import LitBoard
from calib.flash.pairs import FlashPair, LinearPicture, open_pairs, pulses_of
from calib.flash.samples import Refusal, collect_boards, lens_vector, lit_board
from calib.flash.save import flash_evidence_path
from capture.controls import Controls
from capture.frame_record import FrameRecord
from capture.images import write_png
from capture.session import Session
from capture.transfer import to_display, to_linear
from relight.cli import main

SIZE = (640, 480)
LENS = np.array([560.0, 561.0, 321.5, 238.2, -0.12, 0.03, 0.0005, -0.0008, 0.0])
BOARD = Board((5, 7), 0.03, 0.019)
FINE, TEXEL = 2, 64


@dataclass(frozen=True)
class Rig:
    """The truth: a flash beside the lens, a room, a sensor."""

    offset_m: tuple = (0.018, -0.012, -0.004)
    axis: tuple = (0.06, -0.04, 0.9974)
    falloff: float = 2.0
    strength: tuple = (0.056, 0.052, 0.048)
    room: float = 0.04
    vignetting: tuple = (-0.25, 0.05)
    read: float = 0.001
    shot: float = 1e-5
    paper: float = 1.0


RIG = Rig()


@pytest.fixture(scope="module")
def rays():
    x, y = np.meshgrid(*((np.arange(side * FINE) + 0.5) / FINE for side in SIZE))
    K = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
    flat = cv2.undistortPoints(pixels, K, LENS[4:], criteria=(3, 20, 1e-9)).reshape(*x.shape, 2)
    # Steps of float32 are 1e-7, or 1e-4 px.
    return np.concatenate([flat, np.ones((*x.shape, 1))], axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def photograph(rays):
    """photograph(rig, pose, ...) -> (with, without) the flash, [H, W, 3] uint8, sRGB."""
    drawings = {}

    def take(rig, pose, seed=0, gain=1.0, board=BOARD, blur_px=0.6, exposure=1.0, moved=None):
        if board not in drawings:
            size = (board.squares[0] * TEXEL, board.squares[1] * TEXEL)
            inner = board.to_opencv().generateImage(size, marginSize=0)
            drawings[board] = cv2.copyMakeBorder(inner, *[TEXEL] * 4, cv2.BORDER_CONSTANT, value=255)
        rng = np.random.default_rng(seed)
        pictures = []
        for flash, (rotation, translation) in ((gain, pose), (0.0, moved or pose)):
            if not pictures or moved:
                albedo, arriving = scene(rig, rotation, translation, drawings[board], board)
            radiance = albedo[..., None] * (rig.room + flash * arriving[..., None] * np.float32(rig.strength))
            radiance = cv2.GaussianBlur(radiance, (0, 0), blur_px * FINE)
            radiance = cv2.resize(radiance, SIZE, interpolation=cv2.INTER_AREA)
            x, y = np.meshgrid(*((np.arange(side) + 0.5 - side / 2) for side in SIZE))
            r2 = 4 * (x * x + y * y) / (SIZE[0] ** 2 + SIZE[1] ** 2)
            radiance *= exposure * (1 + rig.vignetting[0] * r2 + rig.vignetting[1] * r2 * r2)[..., None]
            noise = rng.standard_normal(radiance.shape, np.float32)
            radiance += noise * np.sqrt(rig.read**2 + rig.shot * radiance)
            stored = to_display(radiance.clip(0, 1), "srgb")
            pictures.append(np.rint(255 * stored).astype(np.uint8))
        return pictures

    def scene(rig, rotation, translation, drawing, board):
        inward = rotation[:, 2].astype(np.float32)
        depth = np.float32(inward @ translation) / (rays @ inward)
        places = rays * depth[..., None]
        on_board = (places - np.float32(translation)) @ rotation[:, :2].astype(np.float32)
        texels = (on_board / board.square_m + np.array(board.squares, np.float32) / 2 + 1) * TEXEL - 0.5
        column, row = np.moveaxis(texels.astype(np.float32), -1, 0)
        border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 90}
        print_ = cv2.remap(drawing, column, row, cv2.INTER_LINEAR, **border)
        albedo = rig.paper * (np.float32(0.04) + np.float32(0.96 / 255) * print_)
        to_flash = np.float32(rig.offset_m) - places
        distance = np.sqrt((to_flash**2).sum(-1))
        incidence = np.maximum(-(to_flash @ inward) / distance, 0)
        emission = np.maximum(-(to_flash @ np.float32(rig.axis)) / distance, 0) ** rig.falloff
        return albedo.astype(np.float32), incidence * emission / distance**2

    return take


def random_pose(rng, near=0.3, far=0.5, tilt=0.55):
    z = rng.uniform(near, far)
    rotation = cv2.Rodrigues(rng.uniform(-tilt, tilt, 3))[0]
    return rotation, np.array([rng.uniform(-0.15, 0.15) * z, rng.uniform(-0.08, 0.08) * z, z])


@pytest.fixture(scope="module")
def pairs(photograph):
    """[(lit, unlit)] of ten poses; the flash loses four percent over them."""
    rng = np.random.default_rng(4)
    droop = np.linspace(1.02, 0.98, 10)
    return [photograph(RIG, random_pose(rng), seed, gain) for seed, gain in enumerate(droop)]


def known_camera(flat=True):
    pinhole = Quantity.of(LENS[:4], "px", "truth", [0.1] * 4)
    distortion = Quantity.of(LENS[4:], "1", "truth")
    return Calibration(
        intrinsics=Intrinsics(*SIZE, pinhole, distortion),
        flat_field=Quantity.of(RIG.vignetting, "1", "truth") if flat else None,
    )


def folder_of(pairs, folder):
    for number, (lit, unlit) in enumerate(pairs):
        write_png(folder / f"{number:02d}_flash.png", lit)
        write_png(folder / f"{number:02d}_noflash.png", unlit)
    save_board(BOARD, folder / "board.json")
    save_calibration(known_camera(), folder / "camera.json")
    return folder


def command(folder, *more):
    flags = ["--board", str(folder / "board.json"), "--calibration", str(folder / "camera.json")]
    return main(["calibrate", "flash", str(folder), *flags, *map(str, more)])


def as_pair(*pictures):
    """Lit and unlit picture in linear light."""
    stored = dict(zip(("lit", "unlit"), pictures, strict=True))
    linear = {
        name: LinearPicture(name, image, to_linear(image, "srgb"), (image > 250).any(2))
        for name, image in stored.items()
    }
    return FlashPair(**linear, time_s=0.0)


def look(pair, board=BOARD, flat_field=None):
    """What one pair gives."""
    return lit_board(as_pair(*pair), BoardDetector(board), LENS, flat_field)


def test_a_folder_of_pairs_becomes_a_flash_within_its_uncertainty(tmp_path, pairs, capsys, read_page):
    folder = folder_of(pairs, tmp_path)
    assert command(folder, "--out", tmp_path / "out.json") == 0
    said = capsys.readouterr().out
    assert "10 pairs, 10 used" in said
    found = load_calibration(tmp_path / "out.json")
    truths = {
        "flash_offset_cam_m": RIG.offset_m,
        "flash_axis": RIG.axis,
        "flash_falloff": RIG.falloff,
        "flash_strength": RIG.strength,
    }
    # Ten numbers within 4 standard deviations (chance 6e-4), and these worth having.
    largest = {
        "flash_offset_cam_m": 4e-3,
        "flash_axis": 0.04,
        "flash_falloff": 0.25,
        "flash_strength": 1.5e-3,
    }
    for name, truth in truths.items():
        quantity = getattr(found, name)
        assert (np.abs(quantity.value - truth) < 4 * quantity.sigma + 1e-6).all(), (name, quantity)
        assert (quantity.sigma < largest[name]).all(), (name, quantity.sigma)
        assert "10 boards in 10 poses" in quantity.source
    evidence = json.loads(flash_evidence_path(tmp_path / "out.json").read_text())
    assert np.array(evidence["covariance"]).shape == (8, 8)
    assert len(evidence["pulses"]) == 10
    droop = evidence["droop"]
    assert abs(droop["change"] - (0.98 / 1.02 - 1)) < 4 * droop["sigma"] < 0.04
    assert evidence["held_out"]["rms"] < 1.5 * evidence["held_out"]["expected"] < 0.03
    page = read_page(tmp_path / "out.json")
    assert "boards left out are off by" in page
    assert page.count("<svg") >= 4
    assert not (tmp_path / "calibration.json").exists()


def test_a_session_is_read_as_a_folder_is_and_keeps_its_other_entries(tmp_path, pairs):
    path = tmp_path / "session"
    with Session.create(
        path, source={"kind": "test"}, width=SIZE[0], height=SIZE[1], transfer="srgb"
    ) as session:
        for number, (lit, unlit) in enumerate(pairs):
            for step, (image, flash) in enumerate(((unlit, 0), (lit, 1))):
                index = 2 * number + step
                file = session.write_frame(index, image)
                session.append_frame(
                    FrameRecord(
                        index=index,
                        file=file,
                        width=SIZE[0],
                        height=SIZE[1],
                        pts_s=number + step / 30,
                        flash=flash,
                        exposure_s=0.01,
                    )
                )
    save_calibration(known_camera(), path / "calibration.json")
    save_board(BOARD, tmp_path / "board.json")
    assert main(["calibrate", "flash", str(path), "--board", str(tmp_path / "board.json")]) == 0
    one = load_calibration(path / "calibration.json")
    # Six standard deviations of 0.5 mm; what a folder gives is tested closer.
    assert one.flash_offset_cam_m.value == pytest.approx(RIG.offset_m, abs=3e-3)
    assert one.intrinsics is not None
    assert one.flat_field is not None
    assert one.flash_strength.made_with == Controls(exposure_s=0.01)
    assert one.flash_offset_cam_m.made_with is None  # it holds for every setting


def test_without_a_flat_field_the_falloff_is_named_as_holding_the_lens_too(tmp_path, pairs, capsys):
    folder = folder_of(pairs, tmp_path)
    (folder / "camera.json").unlink()
    save_calibration(known_camera(flat=False), folder / "camera.json")
    assert command(folder, "--paper-albedo", "0.8") == 0
    assert "the falloff holds the lens's own" in capsys.readouterr().out
    found = load_calibration(folder / "camera.json")
    assert found.value("flash_falloff") > RIG.falloff + 0.3
    # Stated for albedo 0.8, the strength is a quarter higher; some percent go with the vignetting.
    assert found.value("flash_strength") == pytest.approx(np.array(RIG.strength) / 0.8, rel=0.08)


def test_a_flat_field_comes_from_the_flash_s_own_light_where_none_is_known(tmp_path, pairs, capsys):
    folder = folder_of(pairs, tmp_path)
    out = tmp_path / "out.json"
    assert command(folder, "--out", out, "--flat") != 0
    assert "has a flat field already" in capsys.readouterr().err
    save_calibration(known_camera(flat=False), folder / "bare.json")
    flags = ["--board", str(folder / "board.json"), "--calibration", str(folder / "bare.json")]
    assert main(["calibrate", "flash", str(folder), *flags, "--flat", "--out", str(out)]) == 0
    found = re.search(r"passes (\S+) ± (\S+) in the corner", capsys.readouterr().out)
    passed, sigma = float(found[1]), float(found[2])
    assert abs(passed - 1 - sum(RIG.vignetting)) < 4 * sigma < 0.12
    known = load_calibration(out)
    assert known.flat_field.value.sum() == pytest.approx(passed - 1, abs=1e-3)
    assert abs(known.flash_falloff.value - RIG.falloff) < 4 * known.flash_falloff.sigma


def test_the_light_of_a_square_is_that_of_the_simulator(photograph):
    rng = np.random.default_rng(2)
    pose = random_pose(rng)
    rig = replace(RIG, read=1e-4, shot=1e-8)
    board = look(photograph(rig, pose), flat_field=np.array(RIG.vignetting))
    assert isinstance(board, LitBoard)
    to_flash = np.array(rig.offset_m) - board.points_cam
    distance = np.linalg.norm(to_flash, axis=1)
    expected = (to_flash @ board.normal_cam) / distance**3
    expected *= np.maximum(-(to_flash @ np.array(rig.axis)) / distance, 0) ** rig.falloff
    # Eight bits of sRGB are steps of 1 %; the mean of some fifty pixels is good to 0.2 %, blur adds 0.3 %.
    np.testing.assert_allclose(
        board.radiance / expected[:, None], np.tile(rig.strength, (len(expected), 1)), rtol=0.01
    )
    np.testing.assert_allclose(board.origin_cam, pose[1], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"exposure": 6.0}, Refusal.CLIPPED),
        ({"gain": 0.0}, Refusal.NO_LIGHT),
        ({"blur_px": 5.0}, Problem.NO_BOARD),
        ({"board": Board((5, 7), 0.03, 0.019, "DICT_6X6_250")}, Problem.NO_BOARD),
        ({"board": Board((7, 5), 0.03, 0.019)}, Problem.OTHER_BOARD),
        ({"board": Board((5, 7), 0.03, 0.0275)}, Refusal.SMALL),
    ],
)
def test_a_pair_that_tells_nothing_is_refused_with_its_reason(photograph, changes, reason):
    pose = (cv2.Rodrigues(np.array([0.3, -0.25, 0.1]))[0], np.array([0.01, 0.0, 0.34]))
    asked = changes["board"] if changes.get("board", BOARD).marker_m > 0.02 else BOARD
    assert look(photograph(RIG, pose, **changes), asked) is reason


def test_of_blurred_pictures_one_is_looked_at_closer(photograph):
    pose = (cv2.Rodrigues(np.array([0.3, -0.25, 0.1]))[0], np.array([0.01, 0.0, 0.34]))
    pair = as_pair(*photograph(RIG, pose, blur_px=5.0))
    collected = collect_boards([pair] * 2, 2, BOARD, known_camera())
    assert collected.describe() == (
        "2 pairs, 0 used, 2 where no board was found; in lit the picture is blurred"
    )


def test_pictures_that_were_swapped_or_moved_are_refused(photograph):
    pose = (cv2.Rodrigues(np.array([0.3, -0.25, 0.1]))[0], np.array([0.01, 0.0, 0.34]))
    lit, unlit = photograph(RIG, pose)
    assert look((unlit, lit)) is Refusal.DARKER
    elsewhere = (pose[0], pose[1] + [0.03, 0.0, 0.0])
    assert look(photograph(RIG, pose, moved=elsewhere)) is Refusal.MOVED


def test_a_hand_that_trembles_does_no_harm(photograph):
    pose = (cv2.Rodrigues(np.array([0.3, -0.25, 0.1]))[0], np.array([0.01, 0.0, 0.34]))
    trembled = (pose[0], pose[1] + [0.004, 0.003, 0.0])
    still, moving = look(photograph(RIG, pose)), look(photograph(RIG, pose, moved=trembled))
    common = np.isin(still.squares, moving.squares), np.isin(moving.squares, still.squares)
    ratio = moving.radiance[common[1]] / still.radiance[common[0]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


def test_a_set_that_tells_nothing_is_one_sentence_and_changes_no_file(tmp_path, photograph, capsys):
    pose = (cv2.Rodrigues(np.array([0.2, 0.1, 0.0]))[0], np.array([0.0, 0.0, 0.34]))
    folder = folder_of([photograph(RIG, pose)] * 7, tmp_path)
    before = (folder / "camera.json").read_bytes()
    assert command(folder) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "known for 1 poses" in said
    assert "6 show it where it was seen already" in said
    assert "7 used" in said
    assert (folder / "camera.json").read_bytes() == before


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda folder: (folder / "camera.json").unlink(), "does not exist"),
        (lambda folder: (folder / "00_noflash.png").unlink(), "holds no pairs"),
        (lambda folder: (folder / "board.json").unlink(), "board.json cannot be read"),
        (lambda folder: write_png(folder / "00_flash.png", np.zeros((48, 64, 3), np.uint8)), "64 x 48"),
        (
            lambda folder: (folder / "camera.json").write_text(
                '{"schema": "relight-calibration", "version": 1}'
            ),
            "no intrinsics",
        ),
    ],
)
def test_what_is_missing_is_named(tmp_path, capsys, prepare, words):
    empty = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    folder = folder_of([(empty, empty)], tmp_path)
    prepare(folder)
    assert command(folder) == 1
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


def test_a_dark_room_is_dark_on_average_once_the_dark_level_is_off(tmp_path):
    rng = np.random.default_rng(1)
    for name in ("0_flash", "0_noflash"):
        noise = rng.normal(10.0, 3.0, (100, 100, 3))
        write_png(tmp_path / f"{name}.png", np.rint(noise).clip(0, 255).astype(np.uint8))
    known = Calibration(dark=Quantity.of([10 / 255] * 3, "1", "truth"))
    (pair,) = open_pairs(tmp_path, known, "linear").pairs()
    # The mean of 30000 pixels of 3 codes is known to 0.02; cut off at black it would be 1.2 codes.
    assert abs(255 * pair.unlit.radiance.mean()) < 0.08


def test_a_source_that_is_not_there_is_named(tmp_path, capsys):
    save_board(BOARD, tmp_path / "board.json")
    assert main(["calibrate", "flash", "nowhere", "--board", str(tmp_path / "board.json")]) == 1
    assert "nowhere is no session and no folder" in capsys.readouterr().err.strip().splitlines()[-1]


def test_no_session_and_lenses_of_more_terms_are_refused(tmp_path):
    with pytest.raises(FlashGeometryError, match="no pairs"):
        open_pairs(tmp_path, Calibration())
    long = Quantity.of([0.1] * 8, "1", "rational")
    with pytest.raises(FlashGeometryError, match="8 distortion terms"):
        lens_vector(Intrinsics(*SIZE, Quantity.of(LENS[:4], "px", ""), long))
    with pytest.raises(FlashGeometryError, match="no intrinsics"):
        collect_boards([], 0, BOARD, Calibration())


def record(index, pts_s, flash, **more):
    return FrameRecord(index=index, file=f"{index}.png", width=9, height=9, pts_s=pts_s, flash=flash, **more)


def test_a_pulse_is_its_sharpest_frame_and_the_nearest_unlit_one_of_its_exposure():
    frames = [
        record(0, 0.0, 0),
        record(1, 0.03, 1, sharpness=1.0),
        record(2, 0.06, 1, sharpness=2.0),
        record(3, 0.10, 0, exposure_s=0.02),
        record(4, 0.96, 0, exposure_s=0.01),
        record(5, 1.03, 1, exposure_s=0.01),
        record(6, 1.06, 0, exposure_s=0.02),
        record(7, 1.03 + 9.0, 1),
        record(8, 1.03 + 9.0, None),
        record(9, 0.02, 0, reasons=("blurred",)),
    ]
    pairs, alone = pulses_of(frames)
    assert [(lit.index, unlit.index) for lit, unlit in pairs] == [(2, 3), (5, 4)]
    assert alone == 1
