"""What is plugged in: cameras with what they are known for, and things that may be a flash."""

from __future__ import annotations

from capture.devices.table import list_cameras, list_flashes, open_camera
from capture.doctor.finding import Finding, Level
from capture.doctor.quirks import known_quirks
from capture.errors import CameraError


def look_at_devices() -> list[Finding]:
    """Findings about what is there; cameras are opened, which changes nothing, serial ports are not."""
    return [*_cameras(), *_flashes()]


def _cameras() -> list[Finding]:
    urls = list_cameras()
    if not urls:
        return [
            Finding(
                "camera",
                Level.NOTE,
                "No camera is plugged in.",
                "Plug in a USB camera, or film with a phone (relight import).",
            )
        ]
    findings = []
    for url in urls:
        try:
            with open_camera(url) as camera:
                info = camera.info
        except CameraError as error:
            findings.append(Finding("camera", Level.BAD, str(error)))
            continue
        findings.append(Finding("camera", Level.GOOD, f"{url}: {info.name} ({info.back_end})"))
        vendor, product, driver = (str(info.details.get(key, "")) for key in ("vendor", "product", "driver"))
        findings += [
            Finding("camera", Level.NOTE, sentence) for sentence in known_quirks(vendor, product, driver)
        ]
    return findings


def _flashes() -> list[Finding]:
    urls = list_flashes()
    if not urls:
        return [
            Finding(
                "flash",
                Level.NOTE,
                "No flash is plugged in.",
                "Flash the firmware onto an Arduino (firmware_protocol/firmware/README.md), plug in a lamp "
                "that docs/capture.md lists, or switch one by hand (--flash manual:).",
            )
        ]
    return [
        Finding("flash", Level.GOOD, f"{url} may be a flash; name it with --flash to try it.") for url in urls
    ]
