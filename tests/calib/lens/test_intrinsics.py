import cv2
import numpy as np
import pytest

from calib.board.charuco import Board
from calib.board.detection import BoardView
from calib.errors import IntrinsicsError
from calib.lens.intrinsics import calibrate_intrinsics
from calib.lens.projection import project


def turned(*angles):
    return cv2.Rodrigues(np.array(angles, dtype=float))[0]


def test_the_truth_is_found_within_the_uncertainty(make_views, board, lens):
    views, _ = make_views(np.random.default_rng(0), 24, noise_px=0.1)
    result = calibrate_intrinsics(views, board)
    free = result.sigma > 0
    assert (np.abs(result.lens - lens)[free] < 4.5 * result.sigma[free]).all()  # nine at once
    assert result.sigma[0] < 1.0  # px: it is an uncertainty that says something
    assert result.uncertainty.noise_px == pytest.approx(0.1, rel=0.06)  # some 700 residuals
    assert result.left_out[1] == 0
    assert result.warnings == [] or all("cover" in sentence for sentence in result.warnings)


def test_a_long_lens_and_a_wide_one_are_started_well(make_views, board):
    for focal, near in ((1500.0, 1.0), (230.0, 0.12)):
        truth = np.array([focal, focal, 240.0, 180.0, -0.02, 0, 0, 0, 0])

        def pose(rng, near=near):
            z = rng.uniform(near, 1.6 * near)
            return turned(*rng.uniform(-0.6, 0.6, 3)), np.array([*rng.uniform(-0.1, 0.1, 2) * near, z])

        views, _ = make_views(np.random.default_rng(1), 20, noise_px=0.05, pose=pose, lens=truth)
        result = calibrate_intrinsics(views, board)
        free = result.sigma > 0
        assert (np.abs(result.lens - truth)[free] < 4.5 * result.sigma[free]).all()


def test_wrong_corners_and_pictures_are_left_out(make_views, board, lens):
    rng = np.random.default_rng(2)
    views, _ = make_views(rng, 20)
    spoiled = []
    for number, view in enumerate(views):
        pixels = view.corners_px.copy()
        if number < 6:
            pixels[rng.integers(len(pixels))] += [3.0, -2.0]  # one wrong corner in each of six
        if number == 9:
            pixels += rng.normal(0, 4.0, pixels.shape)  # a picture of something that moved
        spoiled.append(BoardView(view.name, view.size, view.ids, pixels, 2.0, "both"))
    result = calibrate_intrinsics(spoiled, board)
    assert result.left_out[1] == 1
    assert 6 <= result.left_out[0] <= 8
    assert "view 9" not in result.views
    free = result.sigma > 0
    assert (np.abs(result.lens - lens)[free] < 4.5 * result.sigma[free]).all()


def test_a_noisy_picture_counts_less(make_views, board):
    rng = np.random.default_rng(3)
    views, _ = make_views(rng, 20, noise_px=0.05)
    mixed = [
        BoardView(
            view.name,
            view.size,
            view.ids,
            view.corners_px + rng.normal(0, 0.3 * (n % 2), (len(view.ids), 2)),
            2.0,
            "both",
        )
        for n, view in enumerate(views)
    ]
    result = calibrate_intrinsics(mixed, board, "k1k2p1p2")
    noise = result.uncertainty.view_noise_px
    assert np.median(noise[1::2]) > 3 * np.median(noise[::2])
    # Half of the pictures at a sixth of the noise are worth nearly all there is.
    clean = calibrate_intrinsics(mixed[::2], board, "k1k2p1p2")
    assert result.sigma[0] < 1.3 * clean.sigma[0]


def test_small_terms_that_the_errors_hide_are_in_the_uncertainty(make_views, board, lens):
    """Pictures that are each sheared a little, as by a rolling shutter, of a lens that is a little askew."""
    off = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views, _ = make_views(rng, 16, noise_px=0.05)
        sheared = [
            BoardView(
                view.name,
                view.size,
                view.ids,
                view.corners_px + (view.corners_px - view.corners_px.mean(0)) @ rng.normal(0, 2e-3, (2, 2)),
                2.0,
                "both",
            )
            for view in views
        ]
        result = calibrate_intrinsics(sheared, board)
        assert any("hang together" in sentence for sentence in result.warnings)
        off.append(((result.lens - lens) / np.maximum(result.sigma, 1e-9))[:4])
    # Twenty-four numbers, of which four belong together each: the root mean square is near one.
    assert np.sqrt(np.mean(np.square(off))) < 1.6
    assert np.abs(off).max() < 4.0


def test_the_layout_of_most_views_is_the_boards(make_views):
    board = Board((5, 6), 0.03, 0.022)
    views, _ = make_views(np.random.default_rng(4), 12, board=board)
    named = [
        BoardView(v.name, v.size, v.ids, v.corners_px, 2.0, "current" if n == 3 else "legacy")
        for n, v in enumerate(views)
    ]
    result = calibrate_intrinsics(named, board)
    assert result.board.layout == "legacy"
    assert len(result.views) == 11


def facing(rng):
    """Parallel to the picture, turned in its own plane, near and far."""
    z = rng.uniform(0.2, 0.5)
    return turned(0, 0, rng.uniform(-1, 1)) @ turned(*rng.normal(0, 0.01, 3)), np.array(
        [rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.2, 0.2) * z, z]
    )


def one_tilt(rng):
    z = rng.uniform(0.25, 0.4)
    return turned(0.6, 0.2, 0.1), np.array([rng.uniform(-0.2, 0.2) * z, rng.uniform(-0.15, 0.15) * z, z])


def small_tilts(rng):
    z = rng.uniform(0.3, 0.5)
    return turned(*rng.uniform(-0.12, 0.12, 3)), np.array(
        [rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.2, 0.2) * z, z]
    )


def far_away(rng):
    return turned(*rng.uniform(-0.6, 0.6, 3)), np.array([-0.4, -0.25, 1.4]) + rng.normal(0, 0.01, 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pose": facing}, "nearly the same direction"),
        ({"pose": one_tilt}, "nearly the same direction"),
        ({"pose": small_tilts, "noise_px": 0.4}, "tilted by 30 to 45"),
        ({"pose": far_away}, "one part of the picture"),
        ({"count": 7}, "Only 7 different views"),
        ({"noise_px": 4.0}, "from where any lens would put them|fit no lens|uncertain"),
    ],
)
def test_pictures_that_do_not_tell_are_refused(make_views, board, change, words):
    views, _ = make_views(np.random.default_rng(5), **{"count": 16, **change})
    with pytest.raises(IntrinsicsError, match=words):
        calibrate_intrinsics(views, board)


def test_a_board_that_is_clearly_bent_is_told(make_views, board):
    views, _ = make_views(np.random.default_rng(8), 12, bend_m=0.004)
    result = calibrate_intrinsics(views, board)
    assert any("bent by 4.0 mm" in sentence for sentence in result.warnings)


def test_no_and_unlike_pictures_are_refused(make_views, board):
    with pytest.raises(IntrinsicsError, match="Only 0 different views"):
        calibrate_intrinsics([], board)
    views, _ = make_views(np.random.default_rng(6), 10)
    other = BoardView("other", (360, 480), views[0].ids, views[0].corners_px, 2.0, "both")
    with pytest.raises(IntrinsicsError, match="480 x 360 pixels and 360 x 480 pixels"):
        calibrate_intrinsics([*views, other], board)


def test_a_board_described_wrongly_fits_nothing(make_views, board, lens):
    """Squares that are printed 3 % taller than wide, as by a printer that fits to the page."""
    rng = np.random.default_rng(7)
    views, poses = make_views(rng, 16, noise_px=0.0)
    stretched = []
    for view, (rotation, translation) in zip(views, poses, strict=True):
        corners = board.corners_m[view.ids] * [1.0, 1.03, 1.0]
        pixels = project(lens, corners @ rotation.T + translation) + rng.normal(0, 0.05, (len(corners), 2))
        stretched.append(BoardView(view.name, view.size, view.ids, pixels, 2.0, "both"))
    with pytest.raises(IntrinsicsError, match=r"not square|fit no lens"):
        calibrate_intrinsics(stretched, board)
