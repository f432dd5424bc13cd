"""Strict reading of JSON from outside: every value is checked and every complaint names its place.

`read_json` parses a file; `Fields` reads one object of it. Both raise the error class they are given, so that
a malformed cameras.json is a SourceError and a malformed session.json a SessionError. NaN and infinite
numbers are refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.errors import RelightError

_REQUIRED: Any = object()
_LARGEST_FILE = 1 << 30


class _NotFiniteError(ValueError):
    pass


def _refuse_constant(text: str) -> float:
    raise _NotFiniteError(f"{text} is not a finite number")


def parse_json(text: str | bytes) -> Any:
    """The parsed value of a JSON text; NaN and Infinity are refused.

    Raises:
        ValueError: not JSON; the message says where.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def is_plain_text(text: str) -> bool:
    """Whether a text can be a file's name: JSON can also say NUL and lone surrogates, which are no UTF-8."""
    return "\0" not in text and not any("\ud800" <= character <= "\udfff" for character in text)


def read_json(path: Path, error: type[RelightError]) -> Fields:
    """The object that a JSON file holds."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise error(f"{path} is larger than {_LARGEST_FILE >> 30} GiB, which no file of this kind is.")
        value = parse_json(path.read_bytes())
    except OSError as cause:
        raise error(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    except ValueError as cause:
        raise error(f"{path} is not valid JSON: {cause}.") from cause
    if not isinstance(value, dict):
        raise error(f"{path} must hold one JSON object, not {_kind(value)}.")
    return Fields(value, str(path), error)


@dataclass(frozen=True)
class Fields:
    """One JSON object, its place for messages ("cameras.json: frame 3") and the error to raise."""

    values: Mapping[str, Any]
    place: str
    error: type[RelightError]

    def __contains__(self, key: str) -> bool:
        """Whether the key is there with a value other than null."""
        return self.values.get(key) is not None

    def fail(self, complaint: str) -> RelightError:
        """The error for a complaint about this object, to be raised by the caller."""
        return self.error(f"{self.place}: {complaint}")

    def _get(self, key: str, default: Any) -> Any:
        value = self.values.get(key)
        if value is None and default is _REQUIRED:
            raise self.fail(f'"{key}" is missing.')
        return value

    def text(self, key: str, default: Any = _REQUIRED) -> Any:
        """A string; `default` (any value) when absent or null."""
        value = self._get(key, default)
        if value is None:
            return default
        if not isinstance(value, str):
            raise self.fail(f'"{key}" must be a text, not {_kind(value)}.')
        if not is_plain_text(value):
            raise self.fail(f'"{key}" contains a NUL or half of a surrogate pair.')
        return value

    def number(self, key: str, default: Any = _REQUIRED) -> Any:
        """A finite float; `default` when absent or null."""
        value = self._get(key, default)
        if value is None:
            return default
        return self._finite(value, f'"{key}"')

    def integer(self, key: str, default: Any = _REQUIRED, low: int = -(1 << 53), high: int = 1 << 53) -> Any:
        """A whole number in low..high; 3.0 and true count as whole numbers; `default` when absent or null."""
        value = self._get(key, default)
        if value is None:
            return default
        number = self._finite(value, f'"{key}"')
        if number != int(number) or not low <= number <= high:
            raise self.fail(f'"{key}" is {value!r}; it must be a whole number in {low}..{high}.')
        return int(value)

    def array(self, key: str, shape: tuple[int | None, ...], default: Any = _REQUIRED) -> Any:
        """Finite float64 array of a shape (None = any length); `default` when absent or null."""
        value = self._get(key, default)
        if value is None:
            return default
        wanted = "[" + ", ".join("n" if length is None else str(length) for length in shape) + "]"
        try:
            array: NDArray[np.float64] = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError, RecursionError) as cause:
            raise self.fail(f'"{key}" must be numbers in the shape {wanted}.') from cause
        if array.size == 0 and shape == (None,):
            array = array.reshape(0)
        if array.ndim != len(shape) or any(
            n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
        ):
            raise self.fail(f'"{key}" has the shape {list(array.shape)}; it must be {wanted}.')
        if not np.isfinite(array).all():
            raise self.fail(f'"{key}" contains a value that is not a finite number.')
        return array

    def affine(self, key: str) -> NDArray[np.float64]:
        """[4, 4] of a matrix of 3 or 4 rows, the last of which is 0 0 0 1."""
        rows = self._get(key, _REQUIRED)
        count = 3 if isinstance(rows, list) and len(rows) == 3 else 4
        matrix = np.eye(4)
        matrix[:count] = self.array(key, (count, 4))
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise self.fail(f'the last row of "{key}" must be 0 0 0 1.')
        return matrix

    def child(self, key: str, default: Any = _REQUIRED) -> Any:
        """A nested object as Fields; `default` when absent or null."""
        value = self._get(key, default)
        if value is None:
            return default
        if not isinstance(value, dict):
            raise self.fail(f'"{key}" must be an object, not {_kind(value)}.')
        return Fields(value, f"{self.place}: {key}", self.error)

    def children(self, key: str, name: str) -> Iterator[Fields]:
        """The objects of a list; `name` says what one is ("frame")."""
        value = self._get(key, _REQUIRED)
        if not isinstance(value, list):
            raise self.fail(f'"{key}" must be a list, not {_kind(value)}.')
        for position, item in enumerate(value):
            if not isinstance(item, dict):
                raise self.fail(f'entry {position} of "{key}" must be an object, not {_kind(item)}.')
            yield Fields(item, f"{self.place}: {name} {position}", self.error)

    def _finite(self, value: Any, what: str) -> float:
        if not isinstance(value, int | float):
            raise self.fail(f"{what} must be a number, not {_kind(value)}.")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.fail(f"{what} is not a finite number.")
        return number


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a text", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")
