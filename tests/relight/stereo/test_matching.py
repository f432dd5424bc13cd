import numpy as np
import torch
from ball_scene import camera_at, render

from relight.head_region import HeadRegion
from relight.stereo.matching import Correlation, Warp, agreement, box_mean
from relight.stereo.windows import Window, parallax_px, region_window, transferred

CENTRE = HeadRegion(np.zeros(3), 0.12, "test")


def grey(camera):
    radiance, depth, ball = render(camera, 0)
    return torch.from_numpy(radiance.mean(axis=2) ** 0.45).float(), torch.from_numpy(depth).float(), ball


def test_box_means_are_those_of_plain_loops():
    values = torch.rand(2, 9, 11, generator=torch.Generator().manual_seed(0))
    for radius in (1, 2, 3, 4):
        padded = np.pad(values.numpy(), ((0, 0), (radius, radius), (radius, radius)), mode="edge")
        plain = np.zeros(values.shape)
        for row in range(9):
            for column in range(11):
                window = padded[:, row : row + 2 * radius + 1, column : column + 2 * radius + 1]
                plain[:, row, column] = window.mean(axis=(1, 2))
        assert np.allclose(box_mean(values, radius).numpy(), plain, atol=1e-6)  # float32 sums of 81


def test_the_true_depth_warps_a_source_onto_the_reference():
    reference, source = camera_at(0.0, "a"), camera_at(8.0, "b")
    window = Window(27, 27, 74, 74, 0.5)
    picture, depth, ball = grey(reference)
    warp = Warp(reference, source, window, torch.device("cpu"))
    values, inside = warp.sample(grey(source)[0], 1.0 / window.cut(depth)[None])
    assert inside.all()
    seen = ball[27:101, 27:101]
    seen[:, :8] = seen[:, -8:] = False  # the source does not see the far edge
    error = (values[0] - window.cut(picture)).abs()[torch.from_numpy(seen)]
    assert error.median() < 0.02  # bilinear interpolation of a pattern a few pixels fine


def test_agreement_is_best_at_the_true_depth_whatever_the_exposure():
    reference = camera_at(0.0, "a")
    sources = [camera_at(angle, "b") for angle in (-9.0, 9.0)]
    window = Window(48, 48, 32, 32, 0.5)
    picture, depth, _ = grey(reference)
    warps = [Warp(reference, source, window, torch.device("cpu")) for source in sources]
    true = 1.0 / window.cut(depth)
    for gain, difference in ((1.0, 0.5), (1.3, 0.0)):
        pictures = [gain * grey(source)[0] for source in sources]
        tried = torch.stack([true * factor for factor in (0.94, 0.97, 1.0, 1.03, 1.06)])
        score = agreement(Correlation(window.cut(picture), 3, 0.003), warps, pictures, tried, difference)
        assert (score.argmax(dim=0) == 2).float().mean() > 0.95


def test_no_contrast_agrees_with_everything_alike():
    flat = torch.full((20, 20), 0.4)
    noise = 0.0005 * torch.randn(3, 20, 20, generator=torch.Generator().manual_seed(1))
    score = Correlation(flat + noise[0], 2, 0.003)(flat + noise[1:])
    assert score.abs().max() < 0.1


def test_a_sphere_that_is_not_shown_has_no_window():
    camera = camera_at(0.0, "a")
    assert region_window(camera, HeadRegion(np.array([5.0, 0, 0]), 0.1, "test")) is None
    assert region_window(camera, HeadRegion(np.array([0, 0, 2.0]), 0.1, "test")) is None  # behind it
    assert region_window(camera, HeadRegion(np.zeros(3), 0.6, "test")) is None  # about it
    window = region_window(camera, CENTRE)
    assert window is not None
    assert window.left >= 0
    assert window.left + window.width <= camera.width


def test_parallax_is_that_of_projected_points():
    reference, source = camera_at(0.0, "a"), camera_at(10.0, "b")
    moved = []
    for z in (0.499, 0.501):
        point = np.array([0.0, 0.0, 0.5 - z])
        at = source.cam_from_world[:3, :3] @ point + source.cam_from_world[:3, 3]
        moved.append((source.K @ (at / at[2]))[:2])
    expected = np.linalg.norm(moved[0] - moved[1]) / (1 / 0.499 - 1 / 0.501)
    assert abs(parallax_px(reference, [source], np.zeros(3)) / expected - 1.0) < 1e-3


def test_a_map_of_half_the_resolution_is_read_at_the_same_places():
    camera = camera_at(0.0, "a")
    half = camera.scaled(0.5)
    small, large = region_window(half, CENTRE), region_window(camera, CENTRE)
    assert small is not None
    assert large is not None
    u = torch.arange(small.left, small.left + small.width) + 0.5
    ramp = u[None].expand(small.height, -1).contiguous()
    found = transferred(ramp, small, half, large, camera)
    expected = (torch.arange(large.left, large.left + large.width) + 0.5) / 2
    assert torch.allclose(found[10, 2:-2], expected[2:-2], atol=1e-4)
