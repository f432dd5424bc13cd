"""What geometry from the frames alone costs: poses, cloud and masks withheld one after the other.

    python benchmarks/geometry.py [--portrait-a FOLDER] [--out benchmarks/results/geometry.json]

On portrait_A (skipped with a word where it is not there) the training frames are fitted with everything
given, with the masks found, with cloud and masks found, and with everything found, with and without the
lens known. Per session: errors of the poses, of the cloud against the scanned surface, of the masks, the
fit's table, and seconds and memory of each stage.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from record import ROOT, write_record
from scipy.spatial import cKDTree

from calib.calibration import Calibration, Intrinsics, save_calibration
from capture.calibration_file import Quantity
from capture.cameras import PosedSet, load_posed_set
from capture.frame_record import FrameRecord
from capture.images import read_image
from capture.ply import read_ply
from capture.session import Session
from relight.alignment import Similarity
from relight.evaluate import evaluate
from relight.fit import fit
from relight.metrics import angles_deg
from relight.plan import Action
from relight.stage_cache import StageCache
from relight.truth_cameras import align_to_truth

PACKAGES = ("torch", "numpy", "pycolmap", "opencv-contrib-python-headless")
WITHIN_M = (0.001, 0.002, 0.005)
SEEN_COSINE = 0.35  # a camera that looks at the surface from within 70 degrees sees it
SEEN_VIEWS = 3


@dataclass(frozen=True)
class Case:
    """What a session is given of what could be found."""

    name: str
    poses: bool = False
    cloud: bool = False
    masks: bool = False
    lens: bool = False


CASES = (
    Case("all given", poses=True, cloud=True, masks=True),
    Case("masks found", poses=True, cloud=True),
    Case("cloud and masks found", poses=True),
    Case("all found, lens known", lens=True),
    Case("all found", lens=False),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = os.environ.get("RELIGHT_PORTRAIT_A", ROOT.parent / "shared" / "portrait_A")
    parser.add_argument("--portrait-a", type=Path, default=Path(default))
    parser.add_argument("--only", action="append", help="cases to run (default: all)")
    parser.add_argument("--frames", type=int, help="use about this many of the frames")
    parser.add_argument("--keep", type=Path, help="folder to leave the sessions in")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "geometry.json")
    args = parser.parse_args()
    if not (args.portrait_a / "cameras.json").is_file():
        print(f"skipped: there is no portrait_A in {args.portrait_a}")
        return
    posed = load_posed_set(args.portrait_a)
    results = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        for case in CASES:
            if args.only and case.name not in args.only:
                continue
            session = folder / case.name.replace(" ", "_").replace(",", "")
            shutil.rmtree(session, ignore_errors=True)
            make_session(session, posed, args.portrait_a, case, args.frames)
            # The given cloud is the head alone, for which a plan spares the masks: here they are wanted.
            forced = {} if case.masks else {"masks": Action.RUN}
            fit(session, forced=forced)
            results[case.name] = measure(session, args.portrait_a, case)
            print(json.dumps({case.name: summary(results[case.name])}, indent=1), flush=True)
    write_record(args.out, "geometry", PACKAGES, {"cases": results})


def make_session(folder: Path, posed: PosedSet, root: Path, case: Case, most: int | None) -> None:
    """The training frames with their flash flags, and of the rest what the case gives."""
    frames = [frame for frame in posed.frames if frame.split != "val" and frame.file is not None]
    if most is not None:
        frames = [frames[pick] for pick in np.linspace(0, len(frames) - 1, most).round().astype(int)]
    camera = frames[0].camera
    source = {"kind": "images", "name": posed.name}
    with Session.create(folder, source=source, width=camera.width, height=camera.height) as session:
        for frame in frames:
            assert frame.file is not None
            file = session.write_frame(frame.index, frame.file.read_bytes(), frame.file.suffix)
            session.append_frame(
                FrameRecord(
                    index=frame.index,
                    file=file,
                    width=camera.width,
                    height=camera.height,
                    flash=frame.flash,
                    source=frame.file.name,
                )
            )
        if case.poses:
            session.save_scene_cameras({frame.index: frame.camera for frame in frames})
        if case.cloud:
            shutil.copyfile(root / "points.ply", session.points_path)
        if case.masks:
            session.masks_dir.mkdir(parents=True)
            for frame in frames:
                assert frame.mask is not None
                shutil.copyfile(frame.mask, session.mask_path(frame.index))
    known = {}
    if posed.flash_offset_cam_m is not None:
        known["flash_offset_cam_m"] = Quantity.of(posed.flash_offset_cam_m, "m", "stated by the set")
    if case.lens:
        fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
        pinhole = Quantity.of([fx, fy, cx, cy], "px", "stated by the set")
        known["intrinsics"] = Intrinsics(camera.width, camera.height, pinhole)
    save_calibration(Calibration(**known), session.calibration_path)


def measure(folder: Path, root: Path, case: Case) -> dict[str, Any]:
    """Everything that the truth can tell of a fitted session."""
    session = Session.open(folder)
    cache = StageCache(session)
    result: dict[str, Any] = {"stages": cache.reports()}
    similarity = Similarity(1.0, np.eye(3), np.zeros(3))
    if cache.record("poses") is not None:
        similarity, result["poses"] = align_to_truth(session, root)
    result["cloud"] = cloud_errors(session, similarity, root)
    if not case.masks:
        result["masks"] = mask_errors(session, root)
    result["fit"] = evaluate(folder, root)
    return result


def cloud_errors(session: Session, similarity: Similarity, root: Path) -> dict[str, Any]:
    """Accuracy of the session's points, and completeness on the part of the true surface that is seen."""
    cloud = read_ply(session.points_path)
    points = similarity.points(cloud.points.astype(np.float64))
    truth = read_ply(root / "gt" / "surface.ply")
    assert truth.normals is not None
    seen = truth_seen(truth.points, truth.normals, root)
    to_truth, nearest = cKDTree(truth.points).query(points, workers=-1)
    to_cloud, _ = cKDTree(points).query(truth.points[seen], workers=-1)
    errors = {
        "points": len(points),
        "median_mm": 1000.0 * float(np.median(to_truth)),
        **{f"accuracy_{1000 * d:g}mm": float((to_truth <= d).mean()) for d in WITHIN_M},
        **{f"completeness_{1000 * d:g}mm": float((to_cloud <= d).mean()) for d in WITHIN_M},
    }
    if cloud.normals is not None:
        turned = similarity.directions(cloud.normals.astype(np.float64))
        errors["normals_median_deg"] = float(np.median(angles_deg(turned, truth.normals[nearest])))
    return errors


def truth_seen(points: np.ndarray, normals: np.ndarray, root: Path) -> np.ndarray:
    """[P] bool: seen within 70 degrees by at least three training cameras that have a true depth map."""
    views = np.zeros(len(points), dtype=int)
    maps = 0
    for frame in load_posed_set(root).frames:
        path = root / "gt" / f"depth_{frame.camera.name}.png"
        if frame.split == "val" or not path.is_file():
            continue
        maps += 1
        depth_m = read_image(path).astype(np.float64) / 20_000.0
        camera = frame.camera
        x = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        uv = (x @ camera.K.T)[:, :2] / x[:, 2:]
        inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1) & (x[:, 2] > 0)
        column, row = np.where(inside[:, None], uv, 0).astype(int).T
        visible = inside & (np.abs(depth_m[row, column] - x[:, 2]) < 0.004)
        towards = camera.centre_world - points
        cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
        views += visible & (cosine > SEEN_COSINE)
    return views >= min(SEEN_VIEWS, maps)


def mask_errors(session: Session, root: Path) -> dict[str, float]:
    """IoU at 0.5 over the frames, and within 8 pixels of the true outline, where the hair is."""
    import cv2

    whole, band = [], []
    for record in session.frames:
        found = session.load_mask(record)
        if found is None or record.source is None:
            continue
        true = read_image(root / "mask" / f"{Path(record.source).stem}.png") >= 128
        mask = found >= 128
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (17, 17))
        grown, shrunk = (operation(true.astype(np.uint8), kernel) for operation in (cv2.dilate, cv2.erode))
        near = grown != shrunk
        whole.append(float((mask & true).sum() / max((mask | true).sum(), 1)))
        band.append(float((mask & true & near).sum() / max(((mask | true) & near).sum(), 1)))
    return {
        "frames": len(whole),
        "iou": float(np.mean(whole)),
        "iou_worst": float(np.min(whole)),
        "iou_within_8px_of_the_outline": float(np.mean(band)),
    }


def summary(result: dict[str, Any]) -> dict[str, Any]:
    """The numbers of one case that a person looks at first."""
    fitted = result["fit"]
    return {
        "poses": result.get("poses"),
        "cloud": result["cloud"],
        "masks": result.get("masks"),
        "captured_db": fitted["captured"]["psnr_db"],
        "ssim": fitted["captured"]["ssim"],
        "albedo_db": fitted["albedo"]["psnr_db"],
        "normals_deg": fitted["normals"]["mean_deg"],
        "lights_db": {name: light["psnr_db"] for name, light in fitted["lights"].items()},
        "mask_iou": fitted["mask"]["iou"],
        "seconds": fitted["fit"]["seconds"],
        "peak_memory_mb": fitted["fit"]["peak_memory_mb"],
    }


if __name__ == "__main__":
    main()
