"""The last adjustment of a reconstruction: robust, and with the lens model that the data support."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pycolmap

from relight.sfm.lenses import edge_shift_px, impossible_lens
from relight.sfm.mapping import quiet_colmap

_ROUNDS = 3
_OUTLIER = 5.0  # times the median reprojection error
_OUTLIER_RANGE_PX = (1.0, 3.0)
_LOSS = 0.6  # width of Cauchy's loss, times the median reprojection error
_LOSS_RANGE_PX = (0.1, 1.0)
_LEAST_ANGLE_DEG = 1.0
_LEAST_GAIN = 0.01  # of the robust error, for a lens model with more parameters
_LEAST_SHIFT_PX = 0.2  # mean at the picture's edge, for a lens model with more parameters
_SHORT_TRACK = 3


@dataclass(frozen=True)
class LensTrial:
    """A lens model that was tried.

    Attributes:
        model: COLMAP's name.
        error_px: Robust root mean square of the reprojection error with it.
        chosen: Whether it is the one that is used.
    """

    model: str
    error_px: float
    chosen: bool


def adjust(
    model: pycolmap.Reconstruction, *, refine_lens: bool, principal_point: bool = False, threads: int = -1
) -> None:
    """Adjusts poses, points and, when asked, the lens; takes outliers out between the rounds. In place."""
    with quiet_colmap():
        for last in [False] * (_ROUNDS - 1) + [True]:
            _bundle(model, refine_lens, principal_point, threads)
            error = median_error_px(model)
            limit = float(np.clip(_OUTLIER * error, *_OUTLIER_RANGE_PX))
            manager = pycolmap.ObservationManager(model)
            removed = manager.filter_all_points3D(limit, _LEAST_ANGLE_DEG)
            removed += manager.filter_observations_with_negative_depth()
            if last or removed < 0.002 * model.compute_num_observations():
                break


def choose_lens(
    model: pycolmap.Reconstruction, threads: int = -1
) -> tuple[pycolmap.Reconstruction, list[LensTrial]]:
    """The reconstruction with the simplest lens model that explains it, and what was tried.

    From one focal length alone to two radial terms; a term is kept when it lowers the error by
    more than a percent and moves what is seen by a fifth of a pixel. The principal point stays in the middle:
    on a half circle it trades against the poses.
    """
    best, best_error = _with_lens(model, "SIMPLE_PINHOLE", threads)
    trials = [("SIMPLE_PINHOLE", best_error)]
    chosen = 0
    for name in ("SIMPLE_RADIAL", "RADIAL"):
        if len(trials) > chosen + 1:
            break  # one term did not help; two will not
        candidate, error = _with_lens(model, name, threads)
        trials.append((name, error))
        shift = max(edge_shift_px(camera) for camera in candidate.cameras.values())
        possible = all(impossible_lens(camera) is None for camera in candidate.cameras.values())
        if possible and error < (1.0 - _LEAST_GAIN) * best_error and shift > _LEAST_SHIFT_PX:
            best, best_error, chosen = candidate, error, len(trials) - 1
    return best, [LensTrial(name, error, i == chosen) for i, (name, error) in enumerate(trials)]


def median_error_px(model: pycolmap.Reconstruction) -> float:
    """Median over the points of their mean reprojection error, 0 without points."""
    model.update_point_3d_errors()
    errors = [point.error for point in model.points3D.values()]
    return float(np.median(errors)) if errors else 0.0


def _with_lens(
    model: pycolmap.Reconstruction, name: str, threads: int
) -> tuple[pycolmap.Reconstruction, float]:
    """A copy adjusted with another lens model, and its robust error."""
    candidate = copy.deepcopy(model)
    for camera in candidate.cameras.values():
        focal, (cx, cy) = camera.mean_focal_length(), (camera.width / 2, camera.height / 2)
        before = dict(
            zip((part.strip() for part in camera.params_info.split(",")), camera.params, strict=True)
        )
        k1 = before.get("k", before.get("k1", 0.0))
        camera.model = getattr(pycolmap.CameraModelId, name)
        camera.params = {
            "SIMPLE_PINHOLE": [focal, cx, cy],
            "SIMPLE_RADIAL": [focal, cx, cy, k1],
            "RADIAL": [focal, cx, cy, k1, 0.0],
        }[name]
    with quiet_colmap():
        _bundle(candidate, True, False, threads)
    candidate.update_point_3d_errors()
    long = [point for point in candidate.points3D.values() if point.track.length() >= _SHORT_TRACK]
    errors = np.array([point.error for point in long])
    weights = np.array([point.track.length() for point in long])
    # Points beyond three times the median are mistakes, and say nothing of the lens.
    good = errors <= 3.0 * np.median(errors) if len(errors) else np.zeros(0, bool)
    if not good.any():
        return candidate, float("inf")
    return candidate, float(np.sqrt((weights[good] * errors[good] ** 2).sum() / weights[good].sum()))


def _bundle(model: pycolmap.Reconstruction, refine_lens: bool, principal_point: bool, threads: int) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_lens
    options.refine_extra_params = refine_lens
    options.refine_principal_point = principal_point
    options.print_summary = False
    # Highlights and the head's outline move over the skin and look like features; they bend the path slightly
    # and all alike. A loss that lets go of them bends it less than half as much as a soft absolute value.
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = float(np.clip(_LOSS * median_error_px(model), *_LOSS_RANGE_PX))
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not `pycolmap.bundle_adjustment`, which writes to the terminal whatever the level of its log.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
