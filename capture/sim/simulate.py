"""The two captures that the rig makes: a posed image set and a phone's video, with the truth beside them."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from capture.atomic import atomic_write
from capture.cameras import Camera
from capture.sim.ahead import computed_ahead
from capture.sim.config import RigConfig
from capture.sim.rig import Progress, Rig
from capture.sim.truth import write_cameras, write_clouds, write_frame, write_lights, write_view
from capture.video.writer import VideoWriter

FIRST_VALIDATION_INDEX = 9000  # above any frame of a recording of the rig
_PROBE_SPACING = 5
_BUILD_SHARE = 0.15  # of the time, for the progress


def _nothing(step: str, part: float) -> None:
    del step, part


def simulate_posed_set(
    out: Path, config: RigConfig, progress: Progress | None = None, rig: Rig | None = None
) -> Path:
    """Writes a posed image set with truth: noisy 8-bit frames, each fully lit or not at all; a noisy cloud.

    Args:
        out: folder to write into; made when missing.
        config: the rig.
        progress: told (step, part done 0..1).
        rig: an already built one of the same configuration, to save the time.

    Returns:
        The path of cameras.json.
    """
    say = progress or _nothing
    rig = rig or Rig.build(config, lambda step, part: say(step, _BUILD_SHARE * part))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    cameras, entries = [], []
    every = config.flash_every
    lit = set(range(0, config.posed_frames, every)) if every else set()
    spacing = every if every > 1 else _PROBE_SPACING  # all lit or none: still only some are for validation
    probes = {i for i in range(0, config.posed_frames - 1, spacing) if (i // spacing) % 4 == 2}
    validation = {i + step for i in probes for step in (-1, 0, 1)}
    measured = validation | set(range(0, config.posed_frames, 10))

    def render(index: int) -> Camera:
        time_s = config.path.duration_s * (index + 0.5) / config.posed_frames
        camera = rig.camera(time_s, f"{index:04d}", flash=int(index in lit))
        write_frame(rig, camera, out, time_s=time_s, noise_index=index)
        if index in measured:
            write_view(rig, camera, out, relight=index in probes or index + 1 in probes)
        return camera

    for index, camera in enumerate(computed_ahead(render, range(config.posed_frames))):
        say("render the posed set", _BUILD_SHARE + (0.97 - _BUILD_SHARE) * index / config.posed_frames)
        cameras.append(camera)
        entry = _posed_entry(camera, index, "val" if index in validation else "train", index in measured)
        entries.append(entry | ({"shaken": True} if config.shake.blurs(index) else {}))
    write_cameras(rig, out / "cameras.json", cameras, entries)
    chosen = sorted(validation)
    if chosen:
        write_cameras(
            rig, out / "cameras_val.json", [cameras[i] for i in chosen], [entries[i] for i in chosen]
        )
    write_lights(rig, out)
    write_clouds(rig, out)
    say("posed set written", 1.0)
    return out / "cameras.json"


def simulate_video(
    out: Path, config: RigConfig, progress: Progress | None = None, rig: Rig | None = None
) -> Path:
    """Writes a phone's video `VID_yyyymmdd_hhmmss.mp4` of the rig, with poses, cloud and truth beside it.

    cameras.json has an entry with `pts_s` for each frame of the video (no file); truth.jsonl says for each
    frame what the lamp really did, truth.json the pulses and the resolved configuration. cameras_val.json
    are extra cameras near the path, noise-free, alternately without and with flash, with ground truth.

    Args:
        out: folder to write into; made when missing.
        config: the rig.
        progress: told (step, part done 0..1).
        rig: an already built one of the same configuration, to save the time.

    Returns:
        The path of the mp4.
    """
    say = progress or _nothing
    rig = rig or Rig.build(config, lambda step, part: say(step, _BUILD_SHARE * part))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_lights(rig, out)
    write_clouds(rig, out)
    _write_validation(rig, out)
    path = out / f"VID_{config.start}.mp4"
    cameras, entries, lines = [], [], []
    ends = datetime.strptime(config.start, "%Y%m%d_%H%M%S").replace(tzinfo=UTC) + timedelta(
        seconds=config.path.duration_s
    )
    size = rig.camera(0.0, "size")
    with VideoWriter(
        path,
        size.width,
        size.height,
        codec=config.codec,
        color_range=config.color_range,
        matrix=config.matrix,
        transfer=config.sensor.transfer,
        rotation_deg=config.rotation_deg,
        creation_time=ends,
    ) as video:
        for frame in rig.frames():
            part = frame.pts_s / config.path.duration_s
            say("film", min(1.0, 2 * _BUILD_SHARE + (1.0 - 2 * _BUILD_SHARE) * part))
            video.write(frame.rgb, frame.pts_s)
            camera = replace(frame.camera, flash=frame.truth.flash)
            cameras.append(camera)
            entries.append({"index": frame.truth.index, "pts_s": frame.pts_s, "flash": frame.truth.flash})
            lines.append(json.dumps(asdict(frame.truth)))
    write_cameras(rig, out / "cameras.json", cameras, entries)
    atomic_write(out / "truth.jsonl", ("\n".join(lines) + "\n").encode())
    summary = {"pulses": [asdict(pulse) for pulse in rig.pulses.pulses], "config": asdict(config)}
    atomic_write(out / "truth.json", (json.dumps(summary, indent=1) + "\n").encode())
    say("video written", 1.0)
    return path


def _posed_entry(camera: Camera, index: int, split: str, has_gt: bool) -> dict[str, Any]:
    return {
        "index": index,
        "file": f"frames/{camera.name}.png",
        "linear": f"linear/{camera.name}.exr",
        "mask": f"mask/{camera.name}.png",
        "flash": camera.flash,
        "split": split,
        "has_gt": has_gt,
    }


def _write_validation(rig: Rig, out: Path) -> None:
    """Extra cameras beside the path: a few millimetres to centimetres off it, as a new view should be."""
    config = rig.config
    if not config.validation_views:
        return
    rng = np.random.default_rng([config.path.seed, 31])
    cameras: list[Camera] = []
    times_s: list[float] = []
    for k in range(config.validation_views):
        time_s = config.path.duration_s * (k + 0.5) / config.validation_views
        pose = rig.upright_pose(time_s)
        pose[:3, 3] += rng.normal(0.0, 0.012, 3)
        cameras.append(rig.camera_at(pose, f"{FIRST_VALIDATION_INDEX + k:04d}", flash=k % 2))
        times_s.append(time_s)

    def render(k: int) -> None:
        write_frame(rig, cameras[k], out, time_s=times_s[k], noise_index=None)
        write_view(rig, cameras[k], out, relight=True)

    for _ in computed_ahead(render, range(len(cameras))):
        pass
    entries = [_posed_entry(camera, int(camera.name), "val", True) for camera in cameras]
    write_cameras(rig, out / "cameras_val.json", cameras, entries)
