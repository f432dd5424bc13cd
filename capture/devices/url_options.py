"""The settings in a device's URL: `sim:seed=3;coarse`, `litra:serial=AB12;kelvin=5000`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from capture.errors import DeviceError


def parse_options(
    rest: str, known: Mapping[str, type], error: type[DeviceError], *, scheme: str
) -> dict[str, Any]:
    """The settings of what follows a URL's scheme.

    Args:
        rest: `key=value` and bare `key`s with semicolons between; empty = none.
        known: type of each key's value: str, int, float, or bool for a bare key.
        error: to raise.
        scheme: of the URL, for the message.

    Raises:
        DeviceError: of the kind `error`: an unknown key, or a value that is no such number.
    """
    options: dict[str, Any] = {}
    for setting in filter(None, rest.split(";")):
        key, equals, text = setting.partition("=")
        kind = known.get(key)
        if kind is None or (kind is bool) == bool(equals):
            names = ", ".join(name if kind is bool else f"{name}=..." for name, kind in known.items())
            raise error(
                f"{scheme}:{rest} is not understood at {setting!r}; known are {names or 'no settings'}."
            )
        try:
            options[key] = True if kind is bool else kind(text)
        except ValueError as cause:
            raise error(f"{scheme}:{rest}: {key} is {text!r}, which is no {kind.__name__}.") from cause
    return options
