"""A small scene on the disk in every form that is imported: four pictures, poses, a cloud, masks."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.cameras import Camera
from capture.images import write_jpeg, write_png
from capture.ply import PointCloud, write_ply

WIDTH, HEIGHT = 16, 12
K = np.array([[20.0, 0.0, 8.25], [0.0, 21.0, 6.0], [0.0, 0.0, 1.0]])
COUNT = 4


def poses():
    rng = np.random.default_rng(8)
    found = []
    for _ in range(COUNT):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
        found.append(pose)
    return found


@pytest.fixture(scope="session")
def cameras():
    """The true cameras, in the order of their pictures."""
    return [Camera(f"{i:04d}", WIDTH, HEIGHT, K, pose) for i, pose in enumerate(poses())]


@pytest.fixture
def pictures(tmp_path):
    """A folder with pictures, masks and a cloud: source/{images,masks}/NNNN.*, source/points.ply."""
    source = tmp_path / "source"
    rng = np.random.default_rng(9)
    for folder in ("images", "masks"):
        (source / folder).mkdir(parents=True)
    for i in range(COUNT):
        write_jpeg(source / f"images/{i:04d}.jpg", rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8))
        write_png(source / f"masks/{i:04d}.png", rng.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8))
    write_ply(source / "points.ply", PointCloud(rng.normal(size=(20, 3)).astype(np.float32)))
    return source


@pytest.fixture
def posed(pictures, cameras):
    """The content of a cameras.json for `pictures`; `save` it before importing."""
    return {
        "name": "small",
        "units": "metres",
        "transfer": "sRGB (IEC 61966-2-1)",
        "width": WIDTH,
        "height": HEIGHT,
        "K": K.tolist(),
        "flash": {"offset_cam": [0.01, -0.02, 0.003], "C_flash": [0.7, 0.8, 0.9]},
        "frames": [
            {
                "index": 10 * i,
                "file": f"images/{i:04d}.jpg",
                "mask": f"masks/{i:04d}.png",
                "linear": f"linear/{i:04d}.exr",
                "flash": (1, 0, None, 0)[i],
                "split": "val" if i == 1 else "train",
                "R": camera.cam_from_world[:3, :3].tolist(),
                "t": camera.cam_from_world[:3, 3].tolist(),
            }
            for i, camera in enumerate(cameras)
        ],
    }


@pytest.fixture
def save(pictures):
    """Writes an object as JSON into the source folder."""

    def write(content, name="cameras.json"):
        (pictures / name).write_text(json.dumps(content))
        return pictures

    return write
