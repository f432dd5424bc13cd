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
from capture.devices.v4l2.camera import V4l2Camera
from capture.devices.v4l2.fake_driver import FAKE_PATH, FakeKernel
from capture.devices.v4l2.fake_quirks import PROFILES, Quirks
from capture.errors import CameraError

_RATES = (30.0, 15.0)
_SWITCHES = {field.name: field.type for field in fields(Quirks) if field.type in ("bool", "int")}


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
    settings = dict(part.partition("=")[::2] for part in rest.split(";") if part)
    profile = settings.pop("profile", "plain")
    if profile not in PROFILES:
        raise CameraError(f"fake-v4l2 has no profile {profile!r}; known are {', '.join(PROFILES)}.")
    quirks = PROFILES[profile]
    seed = _number("seed", settings.pop("seed", "0"))
    width, height = settings.pop("width", ""), settings.pop("height", "")
    if bool(width) != bool(height):
        raise CameraError(
            f"fake-v4l2:{rest} is not understood: width and height go together; give both sides."
        )
    if width:
        size = (_even("width", width), _even("height", height))
        quirks = replace(quirks, modes=tuple((name, ((size, _RATES),)) for name, _ in quirks.modes))
    for name, text in settings.items():
        if name not in _SWITCHES:
            known = ", ".join(["profile", "seed", "width", "height", *_SWITCHES])
            raise CameraError(f"fake-v4l2:{rest} is not understood: {name!r} is not one of {known}.")
        number = _number(name, text or "1")
        value = bool(number) if _SWITCHES[name] == "bool" else number
        quirks = replace(quirks, **{name: value})  # type: ignore[arg-type]
    return quirks, seed


def _number(name: str, text: str) -> int:
    if not text.isdecimal():
        raise CameraError(f"fake-v4l2: {name} is {text!r}; it must be a whole number.")
    return int(text)


def _even(name: str, text: str) -> int:
    number = _number(name, text)
    if number < 16 or number % 2 or number > 8192:
        raise CameraError(f"fake-v4l2: {name} is {text}; it must be even, 16..8192.")
    return number
