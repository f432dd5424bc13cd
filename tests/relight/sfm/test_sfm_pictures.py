"""Pictures for the detector: what light does to them, and what it must not."""

import cv2
import numpy as np
import pytest

from relight.sfm.features import Recipe, detect_features
from relight.sfm.pictures import feature_picture, grey_radiance, sharpness, small_picture

ALL = np.ones((160, 160), bool)


def texture(seed=0, size=160):
    noise = np.random.default_rng(seed).normal(size=(size, size)).astype(np.float32)
    return (0.2 * np.exp(0.4 * cv2.GaussianBlur(noise, (0, 0), 2.0) / 0.14)).astype(np.float32)


def test_a_smooth_light_leaves_the_picture_as_it_is():
    unlit = 0.5 * texture()
    across = np.linspace(1.2, 2.5, 160, dtype=np.float32)[None]
    change = np.abs(feature_picture(unlit * across, "local").astype(int) - feature_picture(unlit, "local"))
    assert np.median(change) <= 2  # codes of 255; the floor at black and rounding


def test_faint_detail_is_brought_to_the_level_of_strong_detail():
    faint = (0.2 * (texture() / 0.2) ** 0.2).astype(np.float32)
    strong = feature_picture(texture(), "local").std()
    assert feature_picture(faint, "local").std() > 0.5 * strong
    assert feature_picture(np.full((160, 160), 0.2, np.float32), "local").std() == 0


@pytest.mark.parametrize("kind", ["local", "clahe"])
def test_black_and_white_frames_have_pictures_too(kind):
    for value in (0.0, 1.0):
        assert feature_picture(np.full((80, 60), value, np.float32), kind).shape == (80, 60)


def test_pixels_that_are_not_finite_are_black_and_named():
    radiance = np.full((40, 30, 3), 0.3, np.float32)
    radiance[5, 6] = np.nan
    radiance[7, 8] = np.inf
    grey, finite = grey_radiance(radiance, 100)
    assert not finite[5, 6]
    assert not finite[7, 8]
    assert finite.sum() == 40 * 30 - 2
    assert np.isfinite(grey).all()


def test_large_frames_are_made_smaller_and_small_ones_left():
    grey, finite = grey_radiance(np.ones((300, 600, 3), np.float32), 200)
    assert grey.shape == finite.shape == (100, 200)
    assert grey_radiance(np.ones((30, 60, 3), np.float32), 200)[0].shape == (30, 60)
    assert small_picture(grey).shape == (32, 64)


def test_blur_lowers_the_sharpness_and_exposure_does_not():
    sharp = texture()
    value = sharpness(sharp)
    assert sharpness(0.5 * sharp) == pytest.approx(value, rel=0.1)  # the floor at black
    assert sharpness(cv2.GaussianBlur(sharp, (0, 0), 3.0)) < 0.6 * value
    assert sharpness(np.zeros((50, 50), np.float32)) == 0


def test_a_feature_is_where_its_blob_is():
    v, u = np.mgrid[:160, :160] + 0.5
    centre = np.array([70.3, 81.8])
    blob = 120 * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 4.0**2))
    places, descriptors = detect_features((60 + blob).astype(np.uint8), Recipe(), ALL)
    assert descriptors.shape == (len(places), 128)
    nearest = np.linalg.norm(places - centre, axis=1).min()
    assert nearest < 0.1  # a shift of a half or a quarter pixel would be a wrong convention


def test_no_feature_is_near_pixels_that_cannot_be_used():
    usable = ALL.copy()
    usable[:, 80:] = False
    places, _ = detect_features(feature_picture(texture(), "local"), Recipe(), usable)
    assert len(places) > 20
    assert places[:, 0].max() < 80


def test_a_plain_picture_has_no_features():
    places, descriptors = detect_features(np.full((100, 100), 128, np.uint8), Recipe(), ALL[:100, :100])
    assert places.shape == (0, 2)
    assert descriptors.shape == (0, 128)
