"""A known flash is recovered from boards with known errors, and the claimed uncertainty is the true one.

The boards' squares get noise, texture and a gain a pulse, and their poses the error that corners found to a
tenth of a pixel leave.
"""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from calib.board.charuco import Board
from calib.calibration import Calibration, Intrinsics, Quantity
from calib.errors import FlashGeometryError, FlatFieldError
from calib.flash.boards import LitBoard, merged_stills, stacked
from calib.flash.checks import check_fit, check_poses, distinct_poses, hold_out, weak_directions
from calib.flash.fit import fit_light, pulse_gains
from calib.flash.geometry import calibrate_flash
from calib.flash.lens_falloff import find_flat, fit_lens_falloff
from calib.flash.model import LIGHT_SIZE
from calib.flash.samples import CollectedBoards
from calib.flash.strangers import find_strangers
from calib.lens.projection import project, project_with_slopes
from capture.controls import UNKNOWN

BOARD = Board((5, 7), 0.03, 0.019)
LENS = np.array([840.0, 842.0, 484.0, 354.0, -0.2, 0.08, 0.001, -0.0015, 0.0])
TRUTH = np.array([0.013, -0.007, 0.004, 0.1, -0.05, 1.5, np.log(0.16), -0.03])
COLOUR = np.array([1.1, 1.0, 0.9])
ALL = np.arange(LIGHT_SIZE)


def spread_pose(rng):
    z = rng.uniform(0.25, 0.6)
    turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
    return turn, np.array([rng.uniform(-0.3, 0.3) * z, rng.uniform(-0.22, 0.22) * z, z])


def shine(truth, points, normal, time):
    """Radiance of white, written out: no function of the product."""
    axis = np.array([truth[3], truth[4], 1.0])
    away = points - truth[:3]
    distance = np.linalg.norm(away, axis=-1)
    emission = (away @ (axis / np.linalg.norm(axis)) / distance) ** truth[5]
    return np.exp(truth[6] + truth[7] * time) * -(away @ normal) / distance**3 * emission


def make_boards(rng, count=12, truth=TRUTH, pose=spread_pose, noise=0.003, texture=0.003, pulse=0.01):
    row, column = np.nonzero(~BOARD.black_squares)
    middle = (np.stack([column, row], axis=1) + 0.5 - np.array(BOARD.squares) / 2) * BOARD.square_m
    middle = np.column_stack([middle, np.zeros(len(middle))])
    arm = 0.4 * BOARD.square_m * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    reach = middle[:, None] + arm
    boards = []
    for number in range(count):
        rotation, translation = pose(rng)
        light = shine(
            truth, reach @ rotation.T + translation, -rotation[:, 2], number / (count - 1) - 0.5
        ).mean(1)
        light *= (1 + pulse * rng.normal()) * (1 + rng.normal(size=len(middle)) * np.hypot(noise, texture))
        arms = BOARD.corners_m @ rotation.T
        _, _, by_point = project_with_slopes(LENS, arms + translation)
        slopes = np.concatenate([np.cross(arms[:, None], by_point), by_point], axis=-1).reshape(-1, 6)
        covariance = 0.1**2 * np.linalg.inv(slopes.T @ slopes)
        wrong = np.linalg.cholesky(covariance) @ rng.normal(size=6)
        rotation, translation = cv2.Rodrigues(wrong[:3])[0] @ rotation, translation + wrong[3:]
        boards.append(
            LitBoard(
                name=f"pulse {number}",
                time_s=float(number),
                points_cam=middle @ rotation.T + translation,
                reach_cam=reach @ rotation.T + translation,
                normal_cam=-rotation[:, 2],
                radiance=light[:, None] * COLOUR,
                noise=np.full(len(middle), noise),
                pose_covariance=covariance,
                origin_cam=translation,
                squares=np.arange(len(middle)),
            )
        )
    return boards


def fitted(boards, free=ALL):
    start, kept, lost = find_strangers(boards, free)
    return fit_light(stacked(kept, start), start, free), kept, lost


def test_the_truth_is_where_the_uncertainty_says():
    rng = np.random.default_rng(3)
    trials = 40
    off, joint, spreads = [], [], []
    for _ in range(trials):
        fit, _, _ = fitted(make_boards(rng, 10))
        error = fit.light.vector - TRUTH
        off.append(error / np.sqrt(np.diag(fit.covariance)))
        joint.append(error @ np.linalg.solve(fit.covariance, error))
        spreads.append((fit.spread.texture, fit.spread.pulse))
    off = np.array(off)
    # Of 40 trials, 38 are expected within 95 %; less than 34 has a chance of 0.3 %.
    assert (np.array(joint) < chi2.ppf(0.95, LIGHT_SIZE)).sum() >= 34
    # Standard deviations, each known to 11 %; the variance of Student's t makes the claim a little larger.
    assert (off.std(0) < 1.3).all()
    assert (off.std(0) > 0.6).all()
    # No bias: means of 40 are known to 0.16.
    assert (np.abs(off.mean(0)) < 0.5).all()
    texture, pulse = np.mean(spreads, axis=0)
    assert texture == pytest.approx(0.003, rel=0.1)
    assert pulse == pytest.approx(0.01, rel=0.15)


def test_a_flash_at_arms_length_to_the_side_is_found():
    truth = TRUTH.copy()
    truth[:6] = 0.35, -0.1, 0.02, -0.6, 0.1, 1.0
    fit, _, _ = fitted(make_boards(np.random.default_rng(1), 14, truth))
    sigma = np.sqrt(np.diag(fit.covariance))
    assert (np.abs(fit.light.vector - truth) < 4 * sigma).all()
    assert (sigma[:3] < 0.01).all()


def test_squares_and_pulses_that_do_not_belong_are_left_out_and_change_little():
    rng = np.random.default_rng(5)
    boards = make_boards(rng, 14)
    clean, _, _ = fitted(boards)
    spoiled = []
    for number, board in enumerate(boards):
        radiance = board.radiance.copy()
        if number % 3 == 0:
            radiance[:2] *= 0.6  # a finger's shadow
        if number == 7:
            radiance *= 0.5  # a misfire
        spoiled.append(replace(board, radiance=radiance))
    fit, kept, lost = fitted(spoiled)
    assert lost == 10
    assert [board.name for board in boards if board.name not in {one.name for one in kept}] == ["pulse 7"]
    sigma = np.sqrt(np.diag(clean.covariance))
    assert (np.abs(fit.light.vector - TRUTH) < 4 * np.sqrt(np.diag(fit.covariance))).all()
    assert (np.sqrt(np.diag(fit.covariance)) < 1.6 * sigma).all()


def test_boards_left_out_are_predicted_as_expected_and_a_wrong_model_is_told():
    rng = np.random.default_rng(6)
    boards = make_boards(rng, 14)
    fit, kept, _ = fitted(boards)
    check = hold_out(kept, fit)
    assert check.agrees
    assert 0.6 * check.expected < check.rms < 1.4 * check.expected
    claimed = replace(fit, spread=replace(fit.spread, texture=0.0003, pulse=0.001))
    assert not hold_out(kept, claimed).agrees


def test_pulses_on_a_board_that_stood_still_are_not_taken_for_new_poses():
    rng = np.random.default_rng(14)
    boards = make_boards(rng, 10)
    often = [
        replace(
            board,
            name=f"{board.name}.{pulse}",
            time_s=board.time_s + 0.2 * pulse,
            radiance=board.radiance * (1 + 0.01 * rng.normal()),
        )
        for board in boards
        for pulse in range(4)
    ]
    merged = merged_stills(often)
    assert [board.name for board in merged[:2]] == ["pulse 0.0 and 3 more", "pulse 1.0 and 3 more"]
    assert merged[0].time_s == pytest.approx(0.3)
    once = calibrate_flash(CollectedBoards(boards, 10), Calibration())
    found = calibrate_flash(CollectedBoards(often, 40), Calibration())
    assert len(found.boards) == 10
    # Four pulses on each of ten poses leave the poses' errors: forty boards would claim half of it.
    assert (found.position_sigma_m > 0.75 * once.position_sigma_m).all()


def test_each_pulse_has_its_gain():
    rng = np.random.default_rng(7)
    boards = make_boards(rng, 14, pulse=0.0)
    boards[4] = replace(boards[4], radiance=1.05 * boards[4].radiance)
    fit, kept, _ = fitted(boards)
    gains, sigma = pulse_gains(stacked(kept, fit.light), fit)
    assert int(np.argmax(gains)) == 4
    # What the fit gives way to the one pulse of fourteen is a part of its five percent.
    assert gains[4] == pytest.approx(0.05, abs=0.015)
    assert (sigma < 0.01).all()


def test_the_channels_the_droop_and_the_paper_are_told_apart():
    boards = make_boards(np.random.default_rng(8), 16)
    found = calibrate_flash(CollectedBoards(boards, 16), Calibration(), 0.8)
    truth = 0.16 * COLOUR / 0.8
    sigma = np.sqrt(np.diag(found.strength_covariance))
    assert (np.abs(found.strength - truth) < 4 * sigma).all()
    assert (sigma < 0.02 * truth).all()
    change, uncertainty = found.droop
    assert abs(change - np.expm1(-0.03)) < 4 * uncertainty
    assert found.axis_known
    assert not any("albedo 1" in note for note in found.notes)


def test_a_flash_without_falloff_has_no_axis_to_be_told():
    truth = TRUTH.copy()
    truth[3:6] = 0.0
    found = calibrate_flash(
        CollectedBoards(make_boards(np.random.default_rng(9), 14, truth), 14), Calibration()
    )
    assert not found.axis_known
    assert found.fit.light.axis.tolist() == [0.0, 0.0, 1.0]
    sigma = np.sqrt(np.diag(found.fit.covariance))
    assert found.fit.light.vector[5] < 4 * sigma[5]
    assert (np.abs(found.fit.light.position_m - truth[:3]) < 4 * sigma[:3]).all()
    assert any("too weak for the axis" in note for note in found.notes)


def parallel_pose(rng):
    return np.eye(3), np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.38, 0.4)])


def test_parallel_boards_at_one_distance_are_refused():
    boards = make_boards(np.random.default_rng(10), 14, pose=parallel_pose)
    with pytest.raises(FlashGeometryError, match=r"parallel \(within .* at one distance \(0\.\d+ to"):
        calibrate_flash(CollectedBoards(boards, 14), Calibration())


def test_one_pose_again_and_again_and_too_few_are_refused():
    boards = make_boards(np.random.default_rng(11), 6)
    assert len(set(distinct_poses([*boards, boards[0]]).tolist())) == 6
    with pytest.raises(FlashGeometryError, match=r"1 poses.* 11 show it where"):
        check_poses([boards[0]] * 12, "")
    with pytest.raises(FlashGeometryError, match=r"5 poses.*at least 6 are needed \(why\)"):
        check_poses(boards[:5], "why")


def far_pose(rng):
    turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
    return turn, np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.95, 1.2)])


def test_what_is_weak_is_named_with_its_size_or_refused():
    rng = np.random.default_rng(12)
    boards = make_boards(rng, 10, pose=far_pose, pulse=0.04)
    fit, _, _ = fitted(boards)
    # Far boards tell the side of a flash badly: it changes the angle of the light by a hundredth of itself.
    assert re.search(r"place to the right by \+\d+ mm\.$", weak_directions(fit)[0])
    both = np.zeros(LIGHT_SIZE)
    both[[2, 6]] = 0.02, -0.1  # 20 mm nearer and a tenth weaker look the same
    (words,) = weak_directions(replace(fit, covariance=np.outer(both, both)))
    assert words.endswith("its place forwards by +20 mm with its strength by -10 %.")
    useless = replace(fit, covariance=100 * fit.covariance)
    with pytest.raises(FlashGeometryError, match=r"known only to \d+ mm along"):
        check_fit(useless, boards)
    strong, _, _ = fitted(make_boards(rng, 16))
    assert weak_directions(strong) == []


def test_light_that_is_no_near_flash_is_refused():
    rng = np.random.default_rng(13)
    boards = [
        replace(board, radiance=board.radiance * rng.uniform(0.2, 1.8, (len(board.radiance), 1)))
        for board in make_boards(rng, 12)
    ]
    boards = boards[:4] + [
        replace(board, radiance=board.radiance * scale)
        for board, scale in zip(boards[4:], (0.2, 3, 0.3, 4, 0.2, 3, 0.3, 4), strict=True)
    ]
    with pytest.raises(
        FlashGeometryError, match=r"not that of one small flash|known only to|grows with the power"
    ):
        calibrate_flash(CollectedBoards(boards, 12), Calibration())


@pytest.mark.parametrize("power", [0.8, 1.2])
def test_a_wrong_response_is_refused_and_a_right_one_is_not_suspected(power):
    boards = make_boards(np.random.default_rng(3), 14)
    found = calibrate_flash(CollectedBoards(boards, 14), Calibration())
    assert abs(found.exponent[0] - 1) < 3 * found.exponent[1] < 0.03
    bent = [replace(board, radiance=board.radiance**power) for board in boards]
    with pytest.raises(FlashGeometryError, match=r"grows with the power (0\.7|1\.1|1\.2)"):
        calibrate_flash(CollectedBoards(bent, 14), Calibration())


def test_a_response_that_is_a_little_wrong_is_noted():
    boards = make_boards(np.random.default_rng(3), 16)
    bent = [replace(board, radiance=board.radiance**1.025) for board in boards]
    found = calibrate_flash(CollectedBoards(bent, 16), Calibration())
    assert any("grows with the power 1.0" in note for note in found.notes)


def test_an_impossible_albedo_is_refused():
    with pytest.raises(FlashGeometryError, match=r"albedo is 1\.2"):
        calibrate_flash(CollectedBoards([], 0), Calibration(), 1.2)


LENS_PASSES = np.array([-0.3, 0.06])
SIZE = (960, 720)


def near_pose(rng):
    """Boards near the camera, into all corners."""
    z = rng.uniform(0.2, 0.5)
    turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
    return turn, np.array([rng.uniform(-0.4, 0.4) * z, rng.uniform(-0.3, 0.3) * z, z])


def through_the_lens(boards):
    """The boards as a lens that darkens its corners shows them; squares outside the picture are gone."""
    seen = []
    for board in boards:
        off = project(LENS, board.points_cam) - np.array(SIZE) / 2
        r2 = (off**2).sum(1) / (SIZE[0] ** 2 + SIZE[1] ** 2) * 4
        inside = (np.abs(off) < np.array(SIZE) / 2).all(1)
        passed = 1 + LENS_PASSES[0] * r2 + LENS_PASSES[1] * r2**2
        if inside.sum() >= 8:
            seen.append(replace(board, radiance=board.radiance * passed[:, None]).part(inside))
    return seen


def flash_at(*place):
    truth = TRUTH.copy()
    truth[:3] = place
    return truth


def test_lens_and_beam_are_told_apart_where_the_flash_is_beside_the_lens():
    truth = flash_at(0.15, -0.05, 0.01)
    rng = np.random.default_rng(8)
    off, joint = [], []
    for _ in range(12):
        found = fit_lens_falloff(through_the_lens(make_boards(rng, 14, truth, near_pose)), LENS, SIZE)
        passed, sigma = found.corner
        off.append((passed - 1 - LENS_PASSES.sum()) / sigma)
        joint.append(sigma)
    # A root mean square of twelve is known to a fifth; the prior and Student's t make the claim larger.
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.6
    assert np.median(joint) < 0.015
    assert found.reach > 0.8


def test_a_flash_is_where_it_is_when_the_lens_is_found_with_it():
    truth = flash_at(0.15, -0.05, 0.01)
    boards = through_the_lens(make_boards(np.random.default_rng(9), 14, truth, near_pose))
    intrinsics = Intrinsics(*SIZE, Quantity.of(LENS[:4], "px", "truth"), Quantity.of(LENS[4:], "1", "truth"))
    flat = find_flat(CollectedBoards(boards, len(boards)), intrinsics)
    joint = flat.found.covariance[:LIGHT_SIZE, :LIGHT_SIZE]
    known = Calibration(intrinsics=intrinsics, flat_field=flat.entry("boards", UNKNOWN))
    found = calibrate_flash(flat.evened, known, joint=joint)
    sigma = np.sqrt(np.diag(found.fit.covariance))
    assert (np.abs(found.fit.light.vector - truth) < 4 * sigma).all()
    assert sigma[5] > np.sqrt(np.diag(fitted(flat.evened.boards)[0].covariance))[5]  # the lens's share
    assert "from the flash's light" in known.flat_field.source


def test_a_flash_at_the_lens_does_not_tell_the_lens():
    boards = through_the_lens(make_boards(np.random.default_rng(10), 14, flash_at(0.008, 0, 0), near_pose))
    with pytest.raises(FlatFieldError, match="do not tell the lens's fall-off"):
        fit_lens_falloff(boards, LENS, SIZE)
