"""The simulated rig as devices: `sim:seed=3;coarse` is a camera, `sim:` a flash.

They model rolling shutter, noise, jitter of stamps, lost frames, the lamp's rise, fall and droop, and by
settings the accidents of real devices. They do not model a camera's automatics (`fake-v4l2:` has those),
motion blur, compression, or a driver's finite buffers: frames wait until they are read, however late.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from capture.devices.bench import Bench, VirtualClock
from capture.devices.url_options import parse_options
from capture.errors import CameraError, FlashError
from capture.sim.camera_device import CameraFaults, SimulatedCamera
from capture.sim.config import RigConfig
from capture.sim.edge_file import EdgeFile
from capture.sim.flash_device import FlashFaults, SimulatedFlash

_CAMERA_OPTIONS = {
    "seed": int,
    "coarse": bool,
    "fps": float,
    "drop": float,
    "unplug_s": float,
    "drift_s": float,
    "edges": str,
    "unposed": bool,
}
_FLASH_OPTIONS = {"missed": float, "jitter_ms": float, "unplug_s": float, "reset_s": float, "seed": int}


def open_camera(rest: str, bench: Bench) -> SimulatedCamera:
    """The camera of `sim:REST`.

    seed=N      another person in another room
    coarse      a coarse head in small pictures
    fps=30      frames a second
    drop=0.02   share of frames that are lost
    unplug_s=5  it goes away so many seconds after its first frame
    drift_s=5   its exposure changes by itself after so many seconds
    edges=FILE  it is lit by a lamp that writes its edges there (see `edge_file`), in real time
    unposed     it keeps its poses and the scene's points to itself

    Raises:
        CameraError: A setting is not understood.
    """
    options = parse_options(rest, _CAMERA_OPTIONS, CameraError, scheme="sim")
    config = RigConfig.from_seed(options.get("seed", 0))
    if "coarse" in options:
        config = replace(RigConfig.small(), subject=config.subject, room_seed=config.room_seed)
    config = replace(
        config,
        fps=options.get("fps", config.fps),
        path=replace(config.path, duration_s=bench.walk_s),
        sensor=replace(config.sensor, dropped=options.get("drop", config.sensor.dropped)),
    )
    if "edges" in options and isinstance(bench.clock, VirtualClock):
        raise CameraError(f"sim:{rest}: edges=... goes with a flash in real time, not with a simulated one.")
    return SimulatedCamera(
        url=f"sim:{rest}",
        config=config,
        bench=bench,
        edges=EdgeFile(Path(options["edges"])) if "edges" in options else None,
        faults=CameraFaults(options.get("unplug_s"), options.get("drift_s")),
        tells_scene="unposed" not in options,
    )


def open_flash(rest: str, bench: Bench) -> SimulatedFlash:
    """The flash of `sim:REST`.

    missed=0.1   share of pulses that do not happen; 1 = a lamp that is dead
    jitter_ms=1  of the starts
    unplug_s=5   it goes away so many seconds after the train's start
    reset_s=5    it restarts then
    seed=N       of the chance in the above

    Raises:
        FlashError: A setting is not understood.
    """
    options = parse_options(rest, _FLASH_OPTIONS, FlashError, scheme="sim")
    faults = FlashFaults(
        missed=options.get("missed", 0.0),
        jitter_s=1e-3 * options.get("jitter_ms", 0.2),
        unplug_s=options.get("unplug_s"),
        reset_s=options.get("reset_s"),
        seed=options.get("seed", 0),
    )
    return SimulatedFlash(f"sim:{rest}", bench, faults)


def list_cameras() -> tuple[str, ...]:
    """None: a simulated camera is asked for, never found."""
    return ()


def list_flashes() -> tuple[str, ...]:
    """None, likewise."""
    return ()
