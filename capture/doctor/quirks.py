"""Cameras and drivers that are known for something, by USB id or name, and what is done about it.

Sources: the kernel's uvcvideo quirk table (drivers/media/usb/uvc/uvc_driver.c) and the issues of the projects
that are named. All of it is checked by the light on the camera at hand; this only says what to expect.
"""

from __future__ import annotations

#: (vendor, product) in hexadecimal, and a sentence.
_CAMERAS = {
    ("046d", "082d"): "Logitech C920: forgets manual exposure when a stream starts; it is set after that.",
    ("046d", "08e5"): "Logitech C920: forgets manual exposure when a stream starts; it is set after that.",
    ("046d", "085c"): "Logitech C922: its USB clock is unreliable; the host's stamps are used.",
    (
        "046d",
        "0825",
    ): "Logitech C270: exposures beyond its range turn dark instead of bright; the light check sees it.",
    ("045e", "0772"): "Microsoft LifeCam: has only a few real exposure steps; the light check sees it.",
    ("045e", "0779"): "Microsoft LifeCam: has only a few real exposure steps; the light check sees it.",
    ("8086", "0b07"): "Intel RealSense: exposure times are rounded to its own steps; the read-back tells.",
}
_DRIVERS = {
    "uvcvideo": "uvcvideo clamps and rounds controls without a word; what it made of them is read back.",
    "v4l2 loopback": "A loopback device plays what another program sends; nothing of it can be locked.",
    "vivid": "vivid is the kernel's test pattern, not a camera.",
}


def known_quirks(vendor: str, product: str, driver: str) -> list[str]:
    """Sentences about a camera; ids in hexadecimal of four digits, empty where they are not known."""
    found = []
    if (quirk := _CAMERAS.get((vendor.lower(), product.lower()))) is not None:
        found.append(quirk)
    if (quirk := _DRIVERS.get(driver)) is not None:
        found.append(quirk)
    return found
