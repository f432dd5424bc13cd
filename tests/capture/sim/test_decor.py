"""Bare rooms and printed markers."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.sim import Rig, RigConfig
from capture.sim.decor import DecorConfig
from capture.sim.markers import DICTIONARY, PLACES
from capture.sim.rasterize import project
from capture.sim.room import Room
from capture.sim.truth import write_clouds


@pytest.fixture(scope="module")
def large_config() -> RigConfig:
    """A phone's pixels, in which a marker's modules are seen."""
    return replace(RigConfig.small(), width=480, height=640, focal_px=690.0)


@pytest.mark.parametrize(("place", "side_m"), [("walls", 0.15), ("screen", 0.07)])
def test_markers_are_found_where_the_truth_says(
    small_rig: Rig, large_config: RigConfig, place: str, side_m: float
) -> None:
    room = Room.build(0, 0.55, DecorConfig(plain=True, markers=place, marker_side_m=side_m))
    rig = replace(small_rig, config=large_config, room=room)
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY)), cv2.aruco.DetectorParameters()
    )
    by_number = {marker.number: marker for marker in room.markers}
    for time_s in (0.1, 0.85, 1.6):
        camera = rig.camera(time_s, "x")
        code = rig.config.sensor.encode(rig.layers(camera, False).room)
        corners, numbers, _ = detector.detectMarkers(cv2.cvtColor(code, cv2.COLOR_RGB2GRAY))
        assert numbers is not None
        assert len(numbers) >= 2
        for found, number in zip(corners, np.ravel(numbers), strict=True):
            truth, _ = project(camera, by_number[int(number)].corners.astype(np.float32))
            # Unrefined corners lie on the black border's outermost pixels: up to a pixel and a half inside.
            assert np.median(np.linalg.norm(found.reshape(4, 2) + 0.5 - truth, axis=1)) < 2.0
            assert np.abs(found.reshape(4, 2).mean(0) + 0.5 - truth.mean(0)).max() < 1.0


@pytest.mark.parametrize("place", PLACES)
def test_markers_are_squares_of_the_asked_size_that_face_the_head(place: str) -> None:
    panels, markers = PLACES[place](0.08)
    assert len({marker.number for marker in markers}) == len(markers) <= 50
    assert len(panels) >= len(markers)
    for marker in markers:
        edges = np.roll(marker.corners, -1, axis=0) - marker.corners
        assert np.linalg.norm(edges, axis=1) == pytest.approx([0.08] * 4)
        assert np.einsum("ij,ij->i", edges, np.roll(edges, -1, axis=0)) == pytest.approx([0.0] * 4, abs=1e-12)
        assert marker.corners[0, 1] > marker.corners[3, 1]  # the first corner is at the top
        front = np.cross(edges[1], edges[0])  # down x right is towards who sees it the right way round
        centre = marker.corners.mean(axis=0)
        assert front @ -np.array([centre[0], 0.0, centre[2]]) > 0


def test_markers_are_in_the_truth_and_only_where_there_are_some(small_rig: Rig, tmp_path: Path) -> None:
    for folder in ("with", "without"):
        (tmp_path / folder).mkdir()
    write_clouds(small_rig, tmp_path / "without")
    assert not (tmp_path / "without/gt/markers.json").exists()
    decor = DecorConfig(markers="screen", marker_side_m=0.06)
    config = replace(small_rig.config, decor=decor)
    write_clouds(replace(small_rig, config=config, room=Room.build(0, 0.55, decor)), tmp_path / "with")
    truth = json.loads((tmp_path / "with/gt/markers.json").read_text())
    assert (truth["dictionary"], truth["side_m"]) == ("DICT_4X4_50", 0.06)
    assert np.shape(list(truth["corners"].values())) == (40, 4, 3)


def test_a_bare_room_shows_nothing_but_its_edges(small_rig: Rig, large_config: RigConfig) -> None:
    bare = replace(small_rig, config=large_config, room=Room.build(0, 0.55, DecorConfig(plain=True)))
    detail = []
    for rig in (bare, replace(small_rig, config=large_config)):
        layers = rig.layers(rig.camera(0.85, "x"), False)
        behind = cv2.erode((layers.coverage == 0).astype(np.uint8), np.ones((15, 15))).astype(bool)
        radiance = layers.room.mean(axis=-1)
        detail.append(np.abs(cv2.Laplacian(radiance, cv2.CV_32F) / radiance)[behind].mean())
    assert detail[0] < 0.002  # what the coarse grid of the baked light leaves
    assert detail[1] > 10 * detail[0]


def test_the_light_has_the_configured_level_in_a_bare_room_too() -> None:
    room = Room.build(0, 0.4, DecorConfig(plain=True))
    panorama = room.panorama(32)
    assert np.isfinite(panorama).all()
    assert panorama.max() > 0.4


def test_decor_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="floor"):
        DecorConfig(markers="floor")
    with pytest.raises(ValueError, match=r"marker_side_m 0\.5"):
        DecorConfig(markers="walls", marker_side_m=0.5)
