"""COLMAP's mapping, from features and pairs in memory to reconstructions in memory.

The database that COLMAP wants lies in a temporary folder. Its incremental mapper gives the same result for
the same seed; its global one does not and can be silently wrong, so that what it gives must be verified.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from relight.sfm.matching import Pair
from relight.sfm.survey import Look

logger = logging.getLogger(__name__)

LEAST_FRAMES = 3
_MOST_MODELS = 4  # further pieces than these are not worth their time
_LONGEST_GLOBAL_S = 600.0


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keeps COLMAP from writing its log to the terminal; what is wrong comes back as exceptions."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def map_frames(
    looks: Sequence[Look],
    cameras: Mapping[tuple[int, int], pycolmap.Camera],
    pairs: Sequence[Pair],
    *,
    refine_lens: bool,
    global_method: bool = False,
    threads: int = -1,
    seed: int = 0,
) -> list[pycolmap.Reconstruction]:
    """Reconstructions of the frames, the one with the most frames first; none where COLMAP finds no start.

    Args:
        looks: Frames; the image of the n-th has the number n + 1.
        cameras: By size at which frames were looked at.
        pairs: Verified pairs of positions in `looks`.
        refine_lens: Whether focal length and distortion are refined.
        global_method: COLMAP's global mapper instead of the incremental one.
        threads: -1 = all cores.
        seed: Of its random draws.
    """
    if sum(pair.verified for pair in pairs) < LEAST_FRAMES - 1:
        return []
    with tempfile.TemporaryDirectory(prefix="poses-") as folder, quiet_colmap():
        path = Path(folder) / "database.db"
        _write_database(path, looks, cameras, pairs)
        output = Path(folder) / "models"
        output.mkdir()
        if global_method:
            return _largest_first(_map_globally(path, output, threads, seed, refine_lens))
        for eased in (False, True):
            options = _incremental_options(len(looks), threads, seed, refine_lens)
            if eased:  # a short arc has no two frames under a wide angle to start from
                options.mapper.init_min_tri_angle = 4.0
                options.mapper.init_min_num_inliers = 30
            found = pycolmap.incremental_mapping(path, folder, output, options)
            models = _largest_first([found[number] for number in sorted(found)])
            if models:
                return models
    return []


def _largest_first(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    whole = [model for model in models if model.num_reg_images() >= LEAST_FRAMES]
    return sorted(whole, key=lambda model: -model.num_reg_images())


def _map_globally(
    database: Path, output: Path, threads: int, seed: int, refine_lens: bool
) -> list[pycolmap.Reconstruction]:
    """Global mapping in a process of its own: where COLMAP finds no start, it ends the process."""
    command = [sys.executable, "-m", "relight.sfm.global_mapping", str(database), str(output)]
    command += [str(threads), str(seed), str(int(refine_lens))]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    try:
        ended = subprocess.run(
            command, env=environment, capture_output=True, timeout=_LONGEST_GLOBAL_S, check=False
        )
    except subprocess.TimeoutExpired:
        logger.warning("global mapping took longer than %g s and was stopped", _LONGEST_GLOBAL_S)
        return []
    if ended.returncode:
        logger.info("global mapping ended with code %d", ended.returncode)
        return []
    return [pycolmap.Reconstruction(folder) for folder in sorted(output.iterdir()) if folder.is_dir()]


def _write_database(
    path: Path,
    looks: Sequence[Look],
    cameras: Mapping[tuple[int, int], pycolmap.Camera],
    pairs: Sequence[Pair],
) -> None:
    database = pycolmap.Database.open(path)
    try:
        with pycolmap.DatabaseTransaction(database):
            for camera in cameras.values():
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_rig(rig, use_rig_id=True)
            for position, look in enumerate(looks):
                number, camera_id = position + 1, cameras[look.size].camera_id
                image = pycolmap.Image(name=f"{number:06d}", camera_id=camera_id, image_id=number)
                database.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=number, rig_id=camera_id)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, use_frame_id=True)
                database.write_keypoints(number, look.features.places_px.astype(np.float32))
            for pair in pairs:
                if pair.geometry is not None and pair.verified:
                    numbers = (pair.first + 1, pair.second + 1)
                    database.write_matches(*numbers, pair.inliers)
                    database.write_two_view_geometry(*numbers, pair.geometry)
    finally:
        database.close()


def _incremental_options(
    frames: int, threads: int, seed: int, refine_lens: bool
) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = seed
    options.extract_colors = False
    options.min_model_size = min(10, max(LEAST_FRAMES, frames // 4))
    options.max_num_models = _MOST_MODELS
    options.init_num_trials = 50
    options.ba_refine_focal_length = refine_lens
    options.ba_refine_extra_params = refine_lens
    options.ba_refine_principal_point = False
    # Fewer global adjustments on the way than by default: one that matters follows at the end.
    options.ba_global_frames_ratio = 1.3
    options.ba_global_points_ratio = 1.3
    options.ba_global_max_refinements = 2
    options.ba_global_function_tolerance = 1e-5
    options.ba_local_function_tolerance = 1e-4
    options.mapper.abs_pose_refine_focal_length = refine_lens
    options.mapper.abs_pose_refine_extra_params = refine_lens
    options.mapper.init_min_num_inliers = 50  # a head before a plain wall has no more
    options.mapper.abs_pose_min_num_inliers = 20
    options.mapper.filter_max_reproj_error = 3.0
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    return options
