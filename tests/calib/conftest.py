"""Boards seen by a known lens: as corners with known noise, and as pictures rendered through the lens."""

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from calib.board.charuco import Board
from calib.board.detection import BoardView
from calib.lens.bundle import Solution, minimise, observations_of
from calib.lens.projection import project
from calib.lens.uncertainty import uncertainty_of
from relight.cli import main

SIZE = (480, 360)
LENS = np.array([420.0, 421.5, 242.3, 177.1, -0.22, 0.08, 0.001, -0.0015, 0.0])
BOARD = Board((5, 7), 0.03, 0.022)


def random_pose(rng, tilt=0.6, near=0.22, far=0.4):
    """Rotation and translation of a board that a person holds before a camera."""
    rotation = cv2.Rodrigues(rng.uniform(-tilt, tilt, 3))[0]
    z = rng.uniform(near, far)
    return rotation, np.array([rng.uniform(-0.3, 0.3) * z, rng.uniform(-0.22, 0.22) * z, z])


def see(board, pose, lens, rng, noise_px, size, name="view", bend_m=0.0):
    """The corners of a board within the picture, with Gaussian noise; None where too few are."""
    rotation, translation = pose
    corners = board.corners_m.copy()
    half = np.abs(corners[:, :2]).max(0)
    corners[:, 2] += bend_m * (1 - (corners[:, 0] / half[0]) ** 2)
    pixels = project(lens, corners @ rotation.T + translation)
    pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    inside = ((pixels > 3) & (pixels < np.array(size) - 3)).all(1)
    if inside.sum() < 12:
        return None
    return BoardView(name, size, np.nonzero(inside)[0], pixels[inside], 2.0, "both")


@pytest.fixture(scope="session")
def make_views():
    """make_views(rng, count=20, noise_px=0.1, pose=random_pose, ...) -> views and their poses."""

    def make(rng, count=20, noise_px=0.1, pose=random_pose, board=BOARD, lens=LENS, size=SIZE, bend_m=0.0):
        views, poses = [], []
        while len(views) < count:
            tried = pose(rng)
            view = see(board, tried, lens, rng, noise_px, size, f"view {len(views)}", bend_m)
            if view is not None:
                views.append(view)
                poses.append(tried)
        return views, poses

    return make


@pytest.fixture(scope="session")
def render_board():
    """render_board(board, pose, blur_px=0.5, noise=1.5, seed=0) -> [H, W] uint8, through LENS.

    Each pixel is the mean of 2 x 2 rays through the lens, each a look-up in a drawing of the board whose
    squares are 64 pixels: its steps are a tenth of a picture's pixel.
    """
    fine, texel = 2, 64
    x, y = np.meshgrid(*((np.arange(side * fine) + 0.5) / fine for side in SIZE))
    fx, fy, cx, cy = LENS[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)[:, None]
    flat = cv2.undistortPoints(pixels, K, LENS[4:], criteria=(3, 20, 1e-9)).reshape(*x.shape, 2)
    rays = np.concatenate([flat, np.ones((*x.shape, 1))], axis=-1)
    drawings = {}

    def render(board, pose, blur_px=0.5, noise=1.5, seed=0):
        if board not in drawings:
            inner = board.to_opencv().generateImage(
                (board.squares[0] * texel, board.squares[1] * texel), marginSize=0
            )
            drawings[board] = cv2.copyMakeBorder(inner, *[texel] * 4, cv2.BORDER_CONSTANT, value=255)
        rotation, translation = pose
        normal = rotation[:, 2]
        depth = (normal @ translation) / (rays @ normal)
        on_board = (rays * depth[..., None] - translation) @ rotation
        texels = (on_board[..., :2] / board.square_m + np.array(board.squares) / 2 + 1) * texel - 0.5
        column, row = np.moveaxis(texels.astype(np.float32), -1, 0)
        picture = cv2.remap(
            drawings[board], column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120
        )
        picture = cv2.GaussianBlur(picture.astype(np.float32) * 0.7 + 30, (0, 0), blur_px * fine)
        picture = cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA)
        picture += np.random.default_rng(seed).normal(0, noise, picture.shape)
        return np.clip(np.rint(picture), 0, 255).astype(np.uint8)

    return render


@pytest.fixture(scope="session")
def pictures(render_board):
    """Pictures of BOARD that a calibration can be made of, with their poses."""
    rng = np.random.default_rng(11)
    poses = [random_pose(rng) for _ in range(14)]
    return [(render_board(BOARD, pose, seed=seed), pose) for seed, pose in enumerate(poses)]


@pytest.fixture(scope="session")
def fit():
    """fit(views, poses, free) -> observations, solution, uncertainty; from the truth, which is near."""

    def from_truth(views, poses, free):
        observations = observations_of(views, BOARD)
        start = Solution(
            np.concatenate([LENS, [0.0, 0.0]]),
            np.array([rotation for rotation, _ in poses]),
            np.array([translation for _, translation in poses]),
            np.zeros_like(observations.pixels),
            np.inf,
        )
        found = minimise(observations, start, free)
        return observations, found, uncertainty_of(observations, found, free)

    return from_truth


@pytest.fixture(scope="session")
def read_page():
    """read_page(calibration) -> the HTML of its report, which needs nothing from elsewhere and has no nan."""

    def read(calibration):
        out = calibration.with_suffix(".html")
        assert main(["calibrate", "report", str(calibration), "--out", str(out)]) == 0
        html = out.read_text()
        for outside in ("http:", "https:", "<script", "src="):
            assert outside not in html
        assert html.count("<svg") == html.count("</svg>")
        for drawing in re.findall(r"<svg.*?</svg>", html, re.DOTALL):
            ElementTree.fromstring(drawing)  # every mark is closed, every character escaped
        assert "nan" not in re.sub(r"<[^>]*>", "", html)
        assert not re.search(r'="[^"]*nan', html)
        HTMLParser().feed(html)
        return html

    return read


@pytest.fixture(scope="session")
def lens():
    """[9] the lens of the pictures and, unless told otherwise, of the views."""
    return LENS


@pytest.fixture(scope="session")
def board():
    """The board of the pictures and, unless told otherwise, of the views."""
    return BOARD


@pytest.fixture(scope="session")
def size():
    """(width, height) of the pictures."""
    return SIZE
