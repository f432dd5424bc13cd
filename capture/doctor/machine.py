"""The machine: Python, the libraries that talk to devices, the system."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys

from capture.doctor.finding import Finding, Level

_LIBRARIES = {
    "opencv-contrib-python-headless": "pictures, and cameras as the last resort",
    "av": "films",
    "pyserial": "the flash on a serial line",
    "hidapi": "lamps and relays on USB HID",
    "pyusb": "camera controls where there is no V4L2",
    "rawpy": "RAW stills",
    "torch": "the fit",
    "pycolmap": "poses from frames alone",
}
#: Distributions that put other files in the place of ours: (what is wrong with that, what it displaces).
_RIVALS = {
    "hid": ("has the same module name as hidapi and breaks it", "hidapi"),
    "opencv-python": ("writes over the headless OpenCV", "opencv-contrib-python-headless"),
    "opencv-contrib-python": ("writes over the headless OpenCV", "opencv-contrib-python-headless"),
}


def look_at_machine() -> list[Finding]:
    """Findings about everything but devices."""
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}, {_cores()} cores"
    findings = [Finding("machine", Level.GOOD, system)]
    if sys.platform != "linux":
        findings.append(
            Finding(
                "machine",
                Level.NOTE,
                f"On {platform.system()} cameras go through OpenCV, which cannot lock all of them.",
                "Trust only what is verified by light, film with a phone and import it, or use Linux.",
            )
        )
    for name, purpose in _LIBRARIES.items():
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            findings.append(
                Finding("library", Level.BAD, f"{name} is missing ({purpose}).", f"pip install {name}")
            )
        else:
            findings.append(Finding("library", Level.GOOD, f"{name} {version} ({purpose})"))
    for name, (trouble, ours) in _RIVALS.items():
        if _installed(name):
            remedy = f"pip uninstall {name}, then pip install --force-reinstall --no-deps {ours}"
            findings.append(Finding("library", Level.BAD, f"{name} is installed and {trouble}.", remedy))
    findings.append(_libusb())
    return findings


def _libusb() -> Finding:
    try:
        import usb.backend.libusb1

        found = usb.backend.libusb1.get_backend() is not None
    except ImportError:
        found = False
    if found:
        return Finding("library", Level.GOOD, "libusb-1.0 (for pyusb)")
    install = "apt install libusb-1.0-0" if shutil.which("apt") else "install libusb 1.0"
    return Finding(
        "library", Level.NOTE, "libusb-1.0 is missing; uvc: cameras cannot be controlled.", install
    )


def _installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
