"""Measures against plain implementations on numpy and scipy, and at their edges."""

import math

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, distance_transform_edt, uniform_filter

from relight.metrics import (
    alpha_error,
    angles_deg,
    channel_scales,
    mask_iou,
    median_relative_error,
    psnr_db,
    silhouette_f_score,
    ssim,
)


def pictures(seed=0, height=40, width=50):
    """A smooth picture, a noisy one, and a region with a hole that touches the border."""
    random = np.random.default_rng(seed)
    truth = uniform_filter(random.uniform(size=(height, width, 3)), size=(9, 9, 1)).astype(np.float32)
    picture = (truth + random.normal(scale=0.05, size=truth.shape)).astype(np.float32)
    rows, columns = np.mgrid[:height, :width]
    region = (np.hypot(rows - height, columns - width / 2) < 0.8 * width) & (
        np.hypot(rows - 20, columns - 20) > 4
    )
    return picture, truth, region


def disk(radius, centre=(32, 32), size=64):
    rows, columns = np.mgrid[:size, :size] + 0.5
    return (np.hypot(rows - centre[0], columns - centre[1]) < radius).astype(np.float64)


def test_psnr_is_that_of_the_noise():
    truth = np.zeros((200, 200, 3))
    picture = truth + np.random.default_rng(0).normal(scale=0.01, size=truth.shape)
    # 40 dB for a standard deviation of 0.01; 120,000 samples know their variance to 0.4 %, 0.02 dB.
    assert psnr_db(picture, truth, np.ones((200, 200), bool)) == pytest.approx(40.0, abs=0.06)


def test_psnr_counts_the_region_only():
    truth = np.zeros((4, 4, 3))
    picture, region = truth.copy(), np.zeros((4, 4), bool)
    picture[0, 0], region[1:] = 1.0, True
    assert psnr_db(picture, truth, region) == math.inf
    region[0, 0] = True
    # 13 pixels, one of them wrong by 1.
    assert psnr_db(picture, truth, region) == pytest.approx(10 * math.log10(13))


def test_ssim_is_the_plain_formula_with_scipys_window():
    picture, truth, region = pictures()

    def window(image):
        return np.stack([uniform_filter(image[..., c], 7) for c in range(3)], axis=-1)

    x, y = (np.where(region[..., None], image.astype(float), 0.0) for image in (picture, truth))
    mx, my = window(x), window(y)
    vx, vy, vxy = window(x * x) - mx**2, window(y * y) - my**2, window(x * y) - mx * my
    full = ((2 * mx * my + 1e-4) * (2 * vxy + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    # Sums of 49 values in double precision.
    assert ssim(picture, truth, region) == pytest.approx(full[region].mean(), abs=1e-10)


def test_ssim_of_equal_pictures_is_one_and_of_others_less():
    picture, truth, region = pictures()
    assert ssim(truth, truth, region) == pytest.approx(1.0, abs=1e-12)
    assert ssim(picture, truth, region) < 0.9


def test_scales_are_recovered_and_a_black_channel_keeps_one():
    values = np.random.default_rng(0).uniform(size=(1000, 3)).astype(np.float32)
    values[:, 2] = 0.0
    noise = np.random.default_rng(1).normal(scale=0.01, size=(1000, 3))
    scales = channel_scales(values, values * [0.5, 2.0, 7.0] + noise)
    # The error is noise / sqrt(sum of squares) = 0.01 / sqrt(333); five of these.
    np.testing.assert_allclose(scales, [0.5, 2.0, 1.0], atol=0.003)


def test_relative_error_is_over_the_known_values():
    truth = np.array([[1.0, 2.0, 0.0], [4.0, -1.0, 5.0]])
    values = np.array([[1.1, 1.0, 9.0], [4.0, 9.0, 5.5]])
    assert median_relative_error(values, truth) == pytest.approx(np.median([0.1, 0.5, 0.0, 0.1]))


def test_angles_are_exact_even_where_the_arc_cosine_is_not():
    tiny = 1e-6
    angles = angles_deg(
        np.array([[0, 0, 2.0], [0, 0, 1], [0, 0, 1], [math.sin(tiny), 0, math.cos(tiny)]]),
        np.array([[0, 0, 1.0], [0, 3, 0], [0, 0, -1], [0, 0, 1]]),
    )
    np.testing.assert_allclose(angles, [0, 90, 180, math.degrees(tiny)], rtol=1e-9, atol=0)


def test_missing_normals_count_as_a_guess_and_missing_truth_as_nothing():
    zero, up = np.zeros(3), np.array([0.0, 1.0, 0.0])
    angles = angles_deg(np.stack([zero, up, zero]), np.stack([up, zero, zero]))
    assert angles[0] == 90.0
    assert np.isnan(angles[1:]).all()


def test_iou_is_intersection_over_union_at_half():
    first, second = np.zeros((10, 10)), np.zeros((10, 10))
    first[:, :6], second[:, 4:] = 0.7, 0.5
    second[:, 9] = 0.4
    assert mask_iou(first, second) == 20 / 90
    assert mask_iou(first, first) == 1.0
    assert mask_iou(first, 0 * first) == 0.0


def test_alpha_error_is_the_mean_over_a_band_around_the_silhouette():
    truth, mask = disk(20), 0.25 + 0.5 * disk(20)
    mask[32, 32] = 100.0  # far from the silhouette
    assert alpha_error(mask, truth) == pytest.approx(0.25)
    edge = (truth > 0.5) & ~binary_erosion(truth > 0.5)
    band = distance_transform_edt(~edge) <= 5
    wider = disk(22)
    assert alpha_error(wider, truth, band_px=5) == pytest.approx(np.abs(wider - truth)[band].mean())


@pytest.mark.parametrize(("growth", "expected"), [(0, 1.0), (1, 1.0), (6, 0.0)])
def test_silhouette_score_falls_when_the_outline_leaves_its_tolerance(growth, expected):
    assert silhouette_f_score(disk(20 + growth), disk(20)) == expected


def test_silhouette_score_is_that_of_plain_distances():
    first, second = disk(20, (32, 30)), disk(18, (31, 34))

    def edge(mask):
        return (mask > 0.5) & ~binary_erosion(mask > 0.5)

    precision = np.mean(distance_transform_edt(~edge(second))[edge(first)] <= 1.5)
    recall = np.mean(distance_transform_edt(~edge(first))[edge(second)] <= 1.5)
    assert 0.1 < precision < 0.9
    assert silhouette_f_score(first, second) == pytest.approx(2 * precision * recall / (precision + recall))


def test_border_of_the_picture_is_no_silhouette():
    half = np.zeros((64, 64))
    half[32:] = 1.0  # shoulders cut off below and at both sides
    band = np.zeros((64, 64))
    band[32:40] = 1.0  # its upper edge is right, its lower one is wrong
    assert silhouette_f_score(half, half) == 1.0
    # All of the truth is found, half of what was found is wrong.
    assert silhouette_f_score(band, half) == pytest.approx(2 / 3)


def test_strands_count_in_the_silhouette_though_not_in_the_area():
    head = disk(20)
    hair = head.copy()
    hair[2:14, 26:38:4] = 1.0
    assert mask_iou(head, hair) > 0.97
    assert silhouette_f_score(head, hair) < 0.9


def test_nothing_to_measure_is_nan():
    picture, truth, region = pictures()
    nothing, empty = np.zeros_like(region), np.zeros((8, 8))
    assert math.isnan(psnr_db(picture, truth, nothing))
    assert math.isnan(ssim(picture, truth, nothing))
    assert math.isnan(median_relative_error(np.ones((2, 3)), np.zeros((2, 3))))
    assert math.isnan(mask_iou(empty, empty))
    assert math.isnan(alpha_error(empty, empty))
    assert math.isnan(silhouette_f_score(empty, empty))
    assert silhouette_f_score(empty, disk(2, (4, 4), 8)) == 0.0


def test_nan_in_the_region_is_not_passed_over():
    picture, truth, region = pictures()
    picture[tuple(np.argwhere(region)[0])] = np.nan
    assert math.isnan(psnr_db(picture, truth, region))
    assert math.isnan(ssim(picture, truth, region))
