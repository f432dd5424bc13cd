"""The settings behind a device's URL: `PATH;key=value;key=value`."""

from __future__ import annotations

from collections.abc import Collection

from capture.errors import CameraError


def split_settings(url: str, rest: str, known: Collection[str]) -> tuple[str, dict[str, str]]:
    """What stands before the first semicolon, and the settings after it.

    Args:
        url: The whole URL, for messages.
        rest: It without its scheme.
        known: The keys that the back end understands.

    Raises:
        CameraError: A setting that is not understood, or is given twice.
    """
    target, *parts = rest.split(";")
    settings: dict[str, str] = {}
    for part in filter(None, parts):
        key, equals, value = part.partition("=")
        if not equals or key not in known:
            expected = ", ".join(f"{name}=..." for name in known)
            raise CameraError(f"The setting {part!r} of {url} is not understood; known are {expected}.")
        if key in settings:
            raise CameraError(f"{url} gives {key} twice; give it once.")
        settings[key] = value
    return target, settings
