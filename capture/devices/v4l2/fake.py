"""A fake V4L2 driver as a camera: `fake-v4l2:`, `fake-v4l2:profile=c920;seed=1;width=320;height=240`.

The driver is faked at the level of ioctls, so the whole of our V4L2 code runs on it; its profiles have the
faults of real cameras and kernels (`fake_quirks`). Time is the bench's: with a virtual clock a frame takes as
long as it takes to compute, and its lamp is the bench's light.

    profile=NAME    of `fake_quirks.PROFILES`; plain when left out
    seed=N          of scene and noise
    width=, height= the one size that it offers, in all its formats, at 30 and 15 frames a second
    QUIRK, QUIRK=N  a switch of `fake_quirks.Quirks`, for example lost_every=7 or stale_cache

What it does not model: the bus and its bandwidth (but for `no_bandwidth`), compression that varies, lens and
focus, a moving head, the effect of brightness, contrast, saturation, sharpness and the flicker filter, two
programs that stream at once, and pictures sharper than ninety rows.
"""

from __future__ import annotations

from dataclasses import fields, replace

from capture.devices.bench import Bench
from capture.devices.camera import CameraDevice
from capture.devices.url_options import parse_options
from capture.devices.v4l2.camera import V4l2Camera
from capture.devices.v4l2.fake_driver import FAKE_PATH, FakeKernel
from capture.devices.v4l2.fake_quirks import PROFILES, Quirks
from capture.errors import CameraError

_RATES = (30.0, 15.0)
_KINDS = {"bool": bool, "int": int}
_KNOWN = {"profile": str, "seed": int, "width": int, "height": int} | {
    field.name: _KINDS[str(field.type)] for field in fields(Quirks) if str(field.type) in _KINDS
}


def open_camera(rest: str, bench: Bench) -> CameraDevice:
    """The fake camera of a description.

    Raises:
        CameraError: The description is not understood.
    """
    quirks, seed = parse(rest)
    return V4l2Camera(
        FakeKernel(quirks, bench, seed), FAKE_PATH, f"fake-v4l2:{rest}", "fake-v4l2", bench.clock
    )


def list_cameras() -> tuple[str, ...]:
    """None: it is never plugged in by itself."""
    return ()


def parse(rest: str) -> tuple[Quirks, int]:
    """(quirks, seed) of "profile=c920;seed=1;..."."""
    settings = parse_options(rest, _KNOWN, CameraError, scheme="fake-v4l2")
    profile = settings.pop("profile", "plain")
    if profile not in PROFILES:
        raise CameraError(f"fake-v4l2 has no profile {profile!r}; known are {', '.join(PROFILES)}.")
    quirks = PROFILES[profile]
    seed, width, height = (settings.pop(name, 0) for name in ("seed", "width", "height"))
    if width or height:
        sides = (width, height)
        if not all(16 <= side <= 8192 and side % 2 == 0 for side in sides):
            raise CameraError(f"fake-v4l2:{rest}: width and height must both be given, even, 16..8192.")
        quirks = replace(quirks, modes=tuple((name, ((sides, _RATES),)) for name, _ in quirks.modes))
    return replace(quirks, **settings), seed
