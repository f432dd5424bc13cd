"""Finds the face of a scene by what is at hand: position maps, a landmark model, or the cloud alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from capture.cameras import Camera
from relight.errors import PlanError
from relight.face.decision import FaceDecision
from relight.face.head import find_head, head_on_plane, head_report
from relight.face.landmarks import LoadSrgb, detect_landmarks, plane_of_landmarks
from relight.face.map_files import load_position_maps, surface_of_maps
from relight.face.plane import Floats, Plane
from relight.face.prior import FacePrior
from relight.face.surface import FaceSurface, unroll
from relight.face.textures import PositionMap
from relight.face.visibility import texel_cosines
from relight.stages import Progress, no_progress

PROVIDERS = ("auto", "cloud", "landmarks", "maps", "none")

_AGREED_PX = (
    0.03  # of the picture's larger side, between a given map and the surface that it was brought onto
)
_FEWEST_TEXELS = 0.15  # of the texture, that belong to the face


@dataclass(frozen=True)
class FaceConfig:
    """How the face is found.

    Attributes:
        provider: One of `PROVIDERS`. "auto": maps where a folder is given, else landmarks where a model is
            given, else the cloud.
        model: Path of MediaPipe's face landmarker task file; "" = none.
        maps: Folder of position maps NNNNNN.npy; "" = none.
    """

    provider: str = "auto"
    model: str = ""
    maps: str = ""

    def __post_init__(self) -> None:
        if self.provider not in PROVIDERS:
            raise ValueError(f"provider {self.provider!r} is unknown; choose one of {', '.join(PROVIDERS)}")

    @property
    def resolved(self) -> str:
        """The provider that "auto" stands for."""
        if self.provider != "auto":
            return self.provider
        return "maps" if self.maps else "landmarks" if self.model else "cloud"


@dataclass(frozen=True, eq=False)
class FaceResult:
    """What became of the search.

    Attributes:
        prior: None = no face; the fit does without.
        decision: Whether, and why.
        report: Plain numbers and words.
        warnings: Sentences for the user.
    """

    prior: FacePrior | None
    decision: FaceDecision
    report: Mapping[str, Any]
    warnings: tuple[str, ...] = ()


def find_face(
    points: Floats,
    normals_world: Floats,
    albedo: Floats | None,
    cameras: Mapping[int, Camera],
    config: FaceConfig = FaceConfig(),
    *,
    confidence: Floats | None = None,
    load_srgb: LoadSrgb | None = None,
    rotation_deg: int = 0,
    progress: Progress = no_progress,
) -> FaceResult:
    """Finds the face.

    Args:
        points: [P, 3] of the cloud or portrait, world.
        normals_world: [P, 3] unit, outwards.
        albedo: [P, 3] linear; helps, None = not known.
        cameras: By frame index, as the frames are stored; position maps are for undistorted frames.
        config: See there.
        confidence: [P] 0..1, how far the albedo is to be trusted; None = everywhere.
        load_srgb: Gives the pictures, for landmarks.
        rotation_deg: Clockwise turn from the stored pictures to upright ones, as the session records it.
        progress: Told ("face", fraction).

    Raises:
        PlanError: What the configuration names is missing or cannot be used. That there is no face is none.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals_world, np.float64)
    colours = None if albedo is None else np.asarray(albedo, np.float64)
    provider = config.resolved
    if provider == "none":
        return FaceResult(None, FaceDecision(False, "no face prior is wanted"), {"provider": "none"})
    if not cameras:
        return FaceResult(None, FaceDecision(False, "there are no cameras"), {"provider": provider})
    straight = {index: replace(camera, distortion=np.zeros(0)) for index, camera in cameras.items()}
    if provider == "maps":
        return _from_maps(points, normals, cameras, straight, config, progress)
    if provider == "landmarks":
        if load_srgb is None:
            raise PlanError("Landmarks need the frames' pictures; give them or choose another face provider.")
        found = detect_landmarks(Path(config.model), cameras, load_srgb, rotation_deg, progress)
        plane, up = plane_of_landmarks(found, straight, points)
        head = head_on_plane(points, normals, colours, straight, plane, up, len(found))
    else:
        head = find_head(points, normals, colours, straight, confidence, rotation_deg)
    report = head_report(head) | {"provider": provider}
    if not head.decision.found or head.frame is None:
        return FaceResult(None, head.decision, report)
    surface = unroll(points, normals, colours, head.frame)
    share = float((surface.region & surface.valid).float().mean())
    report["face_share"] = round(share, 4)
    if share < _FEWEST_TEXELS:
        reason = f"only {share:.0%} of the face's texture lies on the cloud (at least {_FEWEST_TEXELS:.0%})"
        return FaceResult(None, FaceDecision(False, reason), report)
    cosines = texel_cosines(surface, points, normals, straight, progress)
    return _result(provider, head.decision, surface, head.frame.plane, straight, cosines, None, report)


def _from_maps(
    points: Floats,
    normals: Floats,
    cameras: Mapping[int, Camera],
    straight: Mapping[int, Camera],
    config: FaceConfig,
    progress: Progress,
) -> FaceResult:
    maps = load_position_maps(Path(config.maps), cameras)
    chosen = {index: straight[index] for index in maps}
    surface, plane = surface_of_maps(maps, chosen, points, normals)
    cosines = texel_cosines(surface, points, normals, chosen, progress)
    decision = FaceDecision(True, f"position maps of {len(maps)} frames are given")
    uv_px = torch.from_numpy(np.stack(list(maps.values())))
    report: dict[str, Any] = {"provider": "maps", "found": True, "reason": decision.reason}
    result = _result("maps", decision, surface, plane, chosen, cosines, None, report)
    if result.prior is None:
        return result
    # A map that lies elsewhere than the surface in its frame is wrong there, or shows what is hidden.
    for k, (index, camera) in enumerate(chosen.items()):
        own: PositionMap = result.prior.position_map(index)
        far = (own.uv_px - uv_px[k]).norm(dim=-1) > _AGREED_PX * max(camera.width, camera.height)
        cosines[k][far] = 0
    report["agreeing"] = round(float((cosines > 0).float().mean()), 4)
    return _result("maps", decision, surface, plane, chosen, cosines, uv_px, report)


def _result(
    source: str,
    decision: FaceDecision,
    surface: FaceSurface,
    plane: Plane,
    cameras: Mapping[int, Camera],
    cosines: torch.Tensor,
    uv_px: torch.Tensor | None,
    report: dict[str, Any],
) -> FaceResult:
    shown = (cosines > 0).flatten(1).any(dim=1)
    if not bool(shown.any()):
        return FaceResult(None, FaceDecision(False, "no frame shows the face that the cloud has"), report)
    report["frames"] = int(shown.sum())
    kept = [index for index, sees in zip(cameras, shown.tolist(), strict=True) if sees]
    prior = FacePrior(
        source=source,
        reason=decision.reason,
        surface=surface,
        plane=plane,
        cameras={index: cameras[index] for index in kept},
        cosines=cosines[shown],
        uv_px=None if uv_px is None else uv_px[shown],
        report=report,
    )
    return FaceResult(prior, decision, report)
