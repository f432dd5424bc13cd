"""From frames with poses to a dense cloud: depth maps, what they agree on, and the cloud of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from capture.cameras import Camera
from capture.session import Session
from relight.errors import GeometryError
from relight.head_region import HeadRegion, find_head_region
from relight.stages import Progress, no_progress
from relight.stereo.completion import completed
from relight.stereo.config import DenseCloud, StereoConfig
from relight.stereo.depth import DepthMap, estimate_about, estimate_depth
from relight.stereo.exposure import pair_gain
from relight.stereo.frames import GreyFrames
from relight.stereo.fusion import Agreement, CheckedMap, agree, checked, one_a_cell
from relight.stereo.hull import visual_hull
from relight.stereo.views import choose_sources, directions_from, spread_out
from relight.stereo.windows import region_window

_DEFAULT = StereoConfig()
_FEWEST_FRAMES = 3
_LEAST_ANGLE_DEG = 2.0  # of the directions to two cameras: below it depth is a guess
_DARK = 0.1  # grey value (radiance 0.006) that the brighter half of the head must reach
_KEPT_PICTURES = 48  # all levels of a reference, its sources and those of the next
_NEIGHBOUR_DEG = 35.0
_LEAST_AGREEING = 0.15  # share of the region's pixels that maps must agree on: with wrong poses it is below
_FEWEST_POINTS = 2000
_MOST_AGAINST = 0.5  # of the maps that agree


def dense_cloud(
    session: Session,
    cameras: Mapping[int, Camera],
    sparse_points: NDArray[np.floating] | None = None,
    config: StereoConfig = _DEFAULT,
    device: torch.device | str = "cpu",
    progress: Progress = no_progress,
) -> DenseCloud:
    """The subject's surface, from its frames and their poses alone.

    Args:
        session: Only read. Frames of the validation split are left out. Its masks, where it has some, narrow
            the region, and serve for a visual hull where stereo fails; none is needed.
        cameras: By frame index.
        sparse_points: [P, 3] world; they tell how frames differ in exposure. May be empty or None.
        config: See there.
        device: Where to compute.
        progress: Told ("stereo", fraction).

    Raises:
        GeometryError: Too few frames, no parallax, too dark, or nothing on which the frames agree, and no
            masks for a visual hull either.
    """
    started_s = time.perf_counter()
    progress("stereo", 0.0)
    region = find_head_region(session, cameras, sparse_points)
    frames = GreyFrames(session, cameras, torch.device(device), _KEPT_PICTURES)
    sparse = np.zeros((0, 3)) if sparse_points is None else np.asarray(sparse_points, np.float64)
    work = _Work(frames, region, sparse[np.isfinite(sparse).all(axis=1)], config)
    hull = visual_hull(frames, region)
    try:
        cloud = work.stereo(progress)
        if hull is not None:
            cloud = completed(cloud, hull, frames)
    except GeometryError as failure:
        if hull is None:
            raise
        cloud = DenseCloud(
            hull.points,
            hull.normals_world,
            np.zeros(len(hull.points), np.float32),
            {"method": "visual hull", "masks": hull.masks},
            (f"The cloud is only the visual hull of {hull.masks} masks, without hollows: {failure}",),
        )
    cloud.report["points"] = len(cloud.points)
    cloud.report["region"] = {
        "centre_world": [round(float(x), 5) for x in region.centre_world],
        "radius": round(region.radius, 5),
        "source": region.source,
    }
    cloud.report["seconds"] = round(time.perf_counter() - started_s, 2)
    progress("stereo", 1.0)
    return cloud


class _Work:
    """What the steps share."""

    def __init__(
        self, frames: GreyFrames, region: HeadRegion, sparse: NDArray[np.float64], config: StereoConfig
    ) -> None:
        self.frames, self.region, self.sparse, self.config = frames, region, sparse, config
        self.seconds: dict[str, float] = {}
        self.warnings: list[str] = []

    def stereo(self, progress: Progress) -> DenseCloud:
        """The cloud that depth maps agree on."""
        config = self.config
        group = self._group()
        directions = directions_from(
            self.region.centre_world, [self.frames.cameras[index] for index in group]
        )
        references = [group[place] for place in spread_out(directions, config.references)]
        scale = self._scale(references)
        self._check_light(references, scale)
        passes = 2 if config.second_pass else 1
        done, total = 0, passes * len(references)
        maps: list[CheckedMap] = []
        for index in references:
            sources = [self._sources(index, group, level) for level in range(3)]
            depth = estimate_depth(
                self.frames, index, (sources[0], sources[1], sources[2]), self.region, scale
            )
            maps.append(checked(depth, self.region))
            done += 1
            progress("stereo", 0.9 * done / total)
        if config.second_pass:
            again: list[CheckedMap] = []
            for own, agreement in zip(maps, self._agreements(maps), strict=True):
                depth = self._once_more(own, agreement, self._sources(own.depth.index, group, 2), scale)
                again.append(checked(depth, self.region))
                done += 1
                progress("stereo", 0.9 * done / total)
            maps = again
        return self._fused(maps, scale)

    def _group(self) -> list[int]:
        """The frames to compare with each other: the kind that covers the path better, unlit if in doubt."""
        kinds = [[i for i, flash in self.frames.flash.items() if flash == kind] for kind in (0, 1)]
        unlit, lit = kinds
        group = unlit if len(unlit) >= max(_FEWEST_FRAMES, 0.5 * len(lit)) else lit
        group = [i for i in group if region_window(self.frames.cameras[i], self.region) is not None]
        if len(group) < _FEWEST_FRAMES:
            raise GeometryError(
                f"Only {len(group)} frames of one kind (lit or unlit) have a pose and show the head; dense "
                f"stereo needs {_FEWEST_FRAMES} or more."
            )
        directions = directions_from(self.region.centre_world, [self.frames.cameras[i] for i in group])
        widest = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))
        if widest < _LEAST_ANGLE_DEG:
            raise GeometryError(
                f"The cameras see the head from directions at most {widest:.1f} degrees apart (needed: "
                f"{_LEAST_ANGLE_DEG:g}); move the camera around the head while filming."
            )
        return group

    def _scale(self, references: Sequence[int]) -> float:
        sides = []
        for index in references:
            window = region_window(self.frames.cameras[index], self.region)
            if window is not None:
                sides.append(max(window.width, window.height))
        return min(1.0, self.config.working_px / float(np.median(sides)))

    def _check_light(self, references: Sequence[int], scale: float) -> None:
        bright = []
        for index in references[:: max(1, len(references) // 6)]:
            window = region_window(self.frames.cameras[index].scaled(scale / 4), self.region)
            if window is not None:
                bright.append(float(window.cut(self.frames.grey(index, scale / 4)).quantile(0.75)))
        if bright and float(np.median(bright)) < _DARK:
            raise GeometryError(
                f"The frames are too dark for stereo: the brighter parts about the head have a radiance of "
                f"{np.median(bright) ** (1 / 0.45):.4f} of white (needed: {_DARK ** (1 / 0.45):.3f}); add "
                "room light or expose longer."
            )

    def _sources(self, index: int, group: Sequence[int], level: int) -> dict[int, float]:
        chosen = choose_sources(
            index,
            self.frames.cameras,
            group,
            self.region.centre_world,
            self.config.angles_deg[level],
            self.config.widest_deg,
        )
        return {other: pair_gain(self.frames, index, other, self.sparse) for other in chosen}

    def _agreements(self, maps: Sequence[CheckedMap]) -> Iterator[Agreement]:
        """One after the other: together they would take more memory than the maps."""
        directions = directions_from(self.region.centre_world, [m.depth.camera for m in maps])
        angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
        for place, own in enumerate(maps):
            order = [int(j) for j in np.argsort(angles[place]) if j != place]
            near = [j for j in order if angles[place, j] < _NEIGHBOUR_DEG][: self.config.neighbours]
            yield agree(own, [maps[j] for j in near], self.config.depth_tolerance)

    def _once_more(
        self, own: CheckedMap, agreement: Agreement, sources: Mapping[int, float], scale: float
    ) -> DepthMap:
        depth = own.depth
        good = self._good(agreement)
        place = agreement.place[good]
        row = torch.as_tensor(depth.camera.cam_from_world[2]).to(depth.inverse_depth)
        inverse = depth.inverse_depth.clone().flatten()
        inverse[place] = 1.0 / (agreement.points[good] @ row[:3] + row[3])
        known = own.outside.to(inverse).flatten()
        known[place] = 1.0
        guess = DepthMap(
            depth.index, depth.camera, depth.window, inverse.view_as(depth.inverse_depth), depth.weight
        )
        return estimate_about(
            self.frames, sources, self.region, scale, guess, known.view_as(depth.inverse_depth)
        )

    def _good(self, agreement: Agreement) -> torch.Tensor:
        return (agreement.support >= self.config.fewest_maps) & (
            agreement.against <= _MOST_AGAINST * agreement.support
        )

    def _fused(self, maps: Sequence[CheckedMap], scale: float) -> DenseCloud:
        points, normals, weights, shares = [], [], [], []
        in_region, kept = 0, 0
        for own, agreement in zip(maps, self._agreements(maps), strict=True):
            good = self._good(agreement)
            points.append(agreement.points[good])
            normals.append(agreement.normals[good])
            weights.append(agreement.cosine[good] ** 2 * agreement.support[good])
            shares.append(agreement.support[good] / agreement.asked[good].clamp(min=1.0))
            in_region += int(own.valid.sum())
            kept += int(good.sum())
        share = kept / max(1, in_region)
        if share < _LEAST_AGREEING or kept < _FEWEST_POINTS:
            raise GeometryError(
                f"The frames agree on only {100 * share:.0f} % of what they show of the head (needed: "
                f"{100 * _LEAST_AGREEING:.0f} %): the poses are wrong, the head moved, or the frames are "
                "blurred; find the poses again, or film anew, holding still and moving slowly."
            )
        footprint = np.median([m.depth.window.distance / float(m.depth.camera.K[0, 0]) for m in maps])
        cell = self.config.cell_px * float(footprint)
        merged, directions, member, counts = one_a_cell(
            torch.cat(points), torch.cat(normals), torch.cat(weights), cell
        )
        confidence = torch.zeros(len(counts), device=merged.device)
        confidence.index_add_(0, member, torch.cat(shares))
        confidence = confidence / counts
        several = counts >= 2
        report: dict[str, Any] = {
            "method": "stereo",
            "depth_maps": len(maps),
            "kind": "lit" if self.frames.flash[maps[0].depth.index] == 1 else "unlit",
            "scale": round(scale, 4),
            "agreeing_share": round(share, 4),
            "cell": cell,
        }
        return DenseCloud(
            merged[several].cpu().numpy(),
            directions[several].cpu().numpy(),
            confidence[several].clamp(0.0, 1.0).cpu().numpy(),
            report,
            tuple(self.warnings),
        )
