"""Frames per second of a portrait's views: maps alone, then with each kind of light, with and without shadow.

    python -m benchmarks.render S --out benchmarks/results/render.json
    python -m benchmarks.render S --portrait solve --panorama studio.exr --size 512

S is a session with one or several portraits; those with a network are measured like the others. A view is
that of the middle camera of the capture, at 512 x 512 and 1024 x 1024 pixels of the same field of view.
"first" is what a light costs when it is new (its depth maps, its bounces, the panorama's integrals), the
rest are further views. CPU seconds stand beside wall-clock ones: on a machine with other work only they
can be compared. On CUDA the same is measured where there is a card.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import spread, write_record
from capture.cameras import Camera
from capture.session import Session
from relight.lighting import (
    DirectionalLight,
    EnvironmentLight,
    FlashLight,
    Light,
    PointLight,
    RoomLight,
    SphericalHarmonicsLight,
)
from relight.maps import render_maps
from relight.portrait import Portrait, load_portrait
from relight.render import PortraitRenderer

SIZES_PX = (512, 1024)
LAMP = (-0.5, 0.4, 0.6)


def lights_of(panorama: np.ndarray) -> dict[str, Light]:
    """One of each kind."""
    return {
        "room": RoomLight(),
        "flash": FlashLight(),
        "directional": DirectionalLight(LAMP, ambient=0.5),
        "directional, shadows": DirectionalLight(LAMP, shadows=True),
        "directional, 5 degrees": DirectionalLight(LAMP, shadows=True, angle_deg=5.0),
        "point": PointLight(LAMP),
        "point, 5 cm": PointLight(LAMP, radius=0.05),
        "spherical harmonics": SphericalHarmonicsLight(torch.eye(9, 3)),
        "environment": EnvironmentLight(panorama),
    }


def some_panorama() -> np.ndarray:
    """A dim room with a bright window and a lamp."""
    panorama = np.random.default_rng(0).uniform(0.1, 0.3, (128, 256, 3)).astype(np.float32)
    panorama[40:70, 150:180] = (6.0, 6.5, 7.0)
    panorama[20:24, 60:64] = (80.0, 70.0, 50.0)
    return panorama


def square_view(camera: Camera, size_px: int) -> Camera:
    """A camera's view, as a square picture of another size over the shorter side."""
    scale = size_px / min(camera.width, camera.height)
    K = camera.K * scale
    K[2, 2] = 1.0
    K[:2, 2] -= (scale * np.array([camera.width, camera.height]) - size_px) / 2.0
    return replace(camera, width=size_px, height=size_px, K=K)


def timed(work: Callable[[], object], repeats: int, device: torch.device) -> dict[str, Any]:
    """Wall-clock and CPU seconds of some work."""
    walls, cpus = [], []
    for _ in range(repeats):
        started_s, cpu_s = time.perf_counter(), time.process_time()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        walls.append(time.perf_counter() - started_s)
        cpus.append(time.process_time() - cpu_s)
    return {"wall_s": spread(walls), "cpu_s": spread(cpus), "frames_per_s": 1.0 / float(np.median(walls))}


def measure(
    portrait: Portrait, camera: Camera, lights: dict[str, Light], repeats: int, device: torch.device
) -> dict[str, Any]:
    """All of one portrait at one size."""
    render_maps(portrait, camera)
    result: dict[str, Any] = {"maps": timed(lambda: render_maps(portrait, camera), repeats, device)}
    for shadows in (True, False):
        renderer = PortraitRenderer(portrait, shadows=shadows)
        if shadows:
            caster = renderer._caster
            result["interreflection, once"] = timed(lambda caster=caster: caster.interreflection, 1, device)
        rows: dict[str, Any] = {}
        for name, light in lights.items():

            def view(light: Light = light, renderer: PortraitRenderer = renderer) -> object:
                return renderer.view(camera, {"light": light}, 1)

            rows[name] = {"first": timed(view, 1, device), **timed(view, repeats, device)}
            print(f"  shadows {shadows}, {name}: {rows[name]['frames_per_s']:.2f} frames/s", flush=True)
        result["lights" if shadows else "lights, no shadows"] = rows
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("--portrait", action="append", help="name of a portrait (default: all)")
    parser.add_argument("--panorama", type=Path, help="of the environment (default: a made-up room)")
    parser.add_argument("--size", type=int, action="append", help="side of the picture (default: 512, 1024)")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    session = Session.open(args.session)
    cameras = list(session.load_scene_cameras().values())
    lights = lights_of(some_panorama())
    if args.panorama:
        lights["environment"] = EnvironmentLight.from_file(args.panorama)
    names = args.portrait or sorted(
        folder.name for folder in session.portraits_dir.iterdir() if (folder / "portrait.json").is_file()
    )
    results: dict[str, Any] = {"threads": torch.get_num_threads(), "cuda": "not measured: there is no card"}
    for kind in ("cpu", "cuda"):
        if kind == "cuda" and not torch.cuda.is_available():
            continue
        device = torch.device(kind)
        rows: dict[str, Any] = {}
        for name in names:
            portrait = load_portrait(session.portraits_dir / name, device)
            for size_px in args.size or SIZES_PX:
                print(f"{kind}, {name}, {size_px} px, {len(portrait.points)} points", flush=True)
                camera = square_view(cameras[len(cameras) // 2], size_px)
                rows[f"{name}, {size_px}"] = {
                    "points": len(portrait.points),
                    "decoder": None if portrait.decoder is None else portrait.decoder.kind,
                    **measure(portrait, camera, lights, args.repeats, device),
                }
        results[kind] = rows
    if args.out:
        write_record(args.out, "render", ("torch", "numpy", "scipy"), results)


if __name__ == "__main__":
    main()
