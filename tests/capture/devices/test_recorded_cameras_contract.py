"""Recordings keep the contract of every camera: pictures, a video, and a video through OpenCV itself."""

from pathlib import Path

import numpy as np
import pytest
from camera_contract import CameraContract

from capture.devices.bench import Bench, VirtualClock
from capture.devices.camera import CameraProfile
from capture.devices.table import open_camera
from capture.images import write_png
from capture.video import VideoWriter

COUNT, FPS = 48, 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures")
    for index in range(COUNT):
        write_png(path / f"{index}.png", np.full((24, 32, 3), 5 * index, np.uint8))
    return path


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    with VideoWriter(path, 64, 48) as writer:
        for index in range(COUNT):
            writer.write(np.full((48, 64, 3), 5 * index, np.uint8), index / FPS)
    return path


class Recorded(CameraContract):
    profile = CameraProfile(exposure_s=0.005, settle_frames=0)
    has_exposure = False


class TestPicturesInRealTime(Recorded):
    @pytest.fixture
    def device(self, folder):
        with open_camera(f"replay:{folder}", Bench(VirtualClock())) as camera:
            yield camera


class TestAVideoAsFastAsItGoes(Recorded):
    @pytest.fixture
    def device(self, film):
        with open_camera(f"replay:{film};rate=fast", Bench(VirtualClock())) as camera:
            yield camera


class TestAVideoThroughOpenCv(Recorded):
    @pytest.fixture
    def device(self, film):
        with open_camera(f"opencv:{film}", Bench()) as camera:
            yield camera
