"""Device files that this user may not open, and the udev rules that let the person at the screen do so."""

from __future__ import annotations

import glob
import os
import sys
from pathlib import Path

from capture.doctor.finding import Finding, Level

RULES_FILE = "/etc/udev/rules.d/60-relightable-portrait.rules"
#: Device files, and the group that owns them on Debian and its kin.
_NODES = {
    "/dev/video*": "video",
    "/dev/ttyUSB*": "dialout",
    "/dev/ttyACM*": "dialout",
    "/dev/hidraw*": "plugdev",
}
#: (vendor, product, what): the HID lamps and relays that have a back end.
_HID_DEVICES = (
    ("046d", "c900", "Logitech Litra Glow"),
    ("046d", "c901", "Logitech Litra Beam"),
    ("046d", "b901", "Logitech Litra Beam"),
    ("046d", "c903", "Logitech Litra Beam LX"),
    ("16c0", "05df", "USB HID relay"),
    ("27b8", "01ed", "blink(1)"),
)
_SERIAL_VENDORS = (
    ("2341", "Arduino"),
    ("2a03", "Arduino"),
    ("1a86", "CH340, on many Nanos"),
    ("0403", "FTDI"),
    ("10c4", "CP210x"),
    ("2e8a", "Raspberry Pi Pico"),
)


def udev_rules() -> str:
    """The text of a rules file: the logged-in person may use the devices that have a back end."""
    lines = [
        f"# {RULES_FILE}: cameras need no rule (group video).",
        "# After writing it: sudo udevadm control --reload && sudo udevadm trigger, or plug in again.",
    ]
    for vendor, product, name in _HID_DEVICES:
        match = f'SUBSYSTEM=="hidraw", ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}"'
        lines += [f"# {name}", f'{match}, TAG+="uaccess"']
    for vendor, name in _SERIAL_VENDORS:
        match = f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}"'
        lines += [f"# {name}", f'{match}, TAG+="uaccess", ENV{{ID_MM_DEVICE_IGNORE}}="1"']
    lines += [
        "# UVC cameras whose controls go through pyusb (uvc:)",
        'SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:0e*:*", TAG+="uaccess"',
    ]
    return "\n".join(lines) + "\n"


def look_at_permissions() -> list[Finding]:
    """A finding for each device file that cannot be opened, and one when all can."""
    if sys.platform != "linux":
        return []
    findings, open_ones = [], 0
    for pattern, group in _NODES.items():
        for node in sorted(glob.glob(pattern)):
            if os.access(node, os.R_OK | os.W_OK):
                open_ones += 1
                continue
            findings.append(
                Finding(
                    "permission",
                    Level.BAD,
                    f"You may not open {node} ({_owner(node)}).",
                    f"Write what `relight doctor --udev` prints to {RULES_FILE} and plug the device in "
                    f"again, or `sudo usermod -aG {group} $USER` and log in again.",
                )
            )
    if open_ones:
        findings.append(
            Finding(
                "permission", Level.GOOD, f"{open_ones} device files of cameras and flashes can be opened."
            )
        )
    return findings


def _owner(node: str) -> str:
    """ "root:dialout, crw-rw----"."""
    import grp
    import pwd
    import stat

    status = Path(node).stat()
    try:
        user, group = pwd.getpwuid(status.st_uid).pw_name, grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        user, group = str(status.st_uid), str(status.st_gid)
    return f"{user}:{group}, {stat.filemode(status.st_mode)}"
