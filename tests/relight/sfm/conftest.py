"""Frames of points whose places are known: features and descriptors made without any picture."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from capture.cameras import Camera
from capture.session import FrameRecord, Session
from relight.sfm.features import Features
from relight.sfm.survey import Look

SIZE = (400, 300)
FOCAL_PX = 420.0
K = np.array([[FOCAL_PX, 0, SIZE[0] / 2], [0, FOCAL_PX, SIZE[1] / 2], [0, 0, 1.0]])


def camera_at(eye, target=(0.0, 0.0, 0.0), roll=0.0, index=0):
    """A camera at [3] that looks at [3], the world's +Y up in its picture but for a roll."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [c * right + s * down, -s * right + c * down, forward]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ eye
    return Camera(f"{index:06d}", *SIZE, K, cam_from_world, flash=int(index % 4 == 0))


def arc(count, from_deg=-50.0, to_deg=50.0, distance=0.55):
    """Cameras about the head, held by a hand that is not quite still."""
    random = np.random.default_rng(3)
    cameras = []
    for index, azimuth in enumerate(np.radians(np.linspace(from_deg, to_deg, count))):
        eye = distance * np.array([np.sin(azimuth), 0.05 * np.sin(index), np.cos(azimuth)])
        cameras.append(camera_at(eye, 0.01 * random.normal(size=3), 0.03 * random.normal(), index))
    return cameras


@dataclass
class PointScene:
    """A head of points in a room of points.

    Attributes:
        head: [H, 3].
        room: [R, 3].
        noise_px: of the places.
        seed: of noise and descriptors.
        subject_known: whether looks carry which features are on the head, as masks would.
        random: state.
    """

    head_points: int = 250
    room_points: int = 500
    noise_px: float = 0.15
    seed: int = 0
    subject_known: bool = False
    random: np.random.Generator = field(init=False)

    def __post_init__(self):
        self.random = np.random.default_rng(self.seed)
        ball = self.random.normal(size=(self.head_points, 3))
        self.head = 0.1 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
        self.room = self.random.uniform([-1.6, -0.8, -1.6], [1.6, 0.8, 0.2], (self.room_points, 3))
        self.room[:, 2] = np.where(self.random.random(self.room_points) < 0.6, -1.2, self.room[:, 2])
        raw = self.random.gamma(0.6, 1.0, (self.head_points + self.room_points, 128))
        self.descriptors = np.sqrt(raw / raw.sum(axis=1, keepdims=True))

    def look(self, camera, index, *, flash=0, head_turn=None, room_turn=None, sharpness=0.5, drop=0.1):
        """What a camera sees of the points; a [3, 3] turn moves the head or the room first."""
        head = self.head if head_turn is None else self.head @ head_turn.T
        room = self.room if room_turn is None else self.room @ room_turn.T
        points = np.concatenate([head, room])
        towards = camera.centre_world - head
        faces = (head * towards).sum(axis=1) > 0.02 * np.linalg.norm(towards, axis=1)
        cam = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            places = cam[:, :2] / cam[:, 2:] * FOCAL_PX + K[:2, 2]
        seen = (cam[:, 2] > 0.1) & (places > 2).all(axis=1) & (places < np.array(SIZE) - 2).all(axis=1)
        seen[: len(head)] &= faces
        seen &= self.random.random(len(points)) > drop
        which = self.random.permutation(np.flatnonzero(seen))
        noisy = self.descriptors[which] * (1 + 0.15 * self.random.normal(size=(len(which), 128)))
        noisy = np.abs(noisy) / np.linalg.norm(noisy, axis=1, keepdims=True)
        places = places[which] + self.noise_px * self.random.normal(size=(len(which), 2))
        width, height = SIZE
        record = FrameRecord(
            index=index, file=f"frames/{index:06d}.png", width=width, height=height, flash=flash
        )
        return Look(
            record,
            SIZE,
            Features(
                places,
                np.minimum(np.rint(512 * noisy), 255).astype(np.uint8),
                np.full(len(which), -1, np.int64),
                np.full((len(which), 3), 0.2, np.float32),
            ),
            sharpness,
            np.full((48, 64), 0.2, np.float32),
            which < len(head) if self.subject_known else None,
        )

    def looks(self, cameras, **given):
        """A look for each camera."""
        return [self.look(camera, k, flash=camera.flash, **given) for k, camera in enumerate(cameras)]


@pytest.fixture
def scene():
    """Makes a scene of points."""
    return PointScene


@pytest.fixture
def make_arc():
    """Makes cameras about the head."""
    return arc


@pytest.fixture
def make_camera():
    """Makes one camera."""
    return camera_at


@pytest.fixture
def found_from(tmp_path, monkeypatch):
    """`find_poses` on looks instead of pictures."""
    from relight.sfm import SfmConfig, find, find_poses, search

    def run(looks, refused=None, rotation_deg=0, **settings):
        session = Session.create(
            tmp_path / f"session{len(list(tmp_path.iterdir()))}",
            source={"kind": "test"},
            width=SIZE[0],
            height=SIZE[1],
            rotation_deg=rotation_deg,
        )
        if settings.pop("ways", 1) == 1:  # the ladder repeats itself where features are given
            ladder = find._ladder
            monkeypatch.setattr(find, "_ladder", lambda config: ladder(config)[:1])
        if settings.pop("calibrated", True):
            from calib.calibration import Calibration, Intrinsics, save_calibration
            from capture.calibration_file import Quantity

            pinhole = Quantity.of([FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2], "px", "test")
            save_calibration(Calibration(intrinsics=Intrinsics(*SIZE, pinhole)), session.calibration_path)
        monkeypatch.setattr(search, "survey", lambda *_: (list(looks), dict(refused or {})))
        records = [look.record for look in looks]
        records += [replace(records[0], index=index, file=None) for index in refused or {}]
        session.finish()
        return find_poses(session, records, SfmConfig(threads=1, **settings))

    return run
