"""The part of YAML that calibration files are written in: OpenCV's, ROS's and Kalibr's.

Nested mappings by indentation, lists of `- item` lines, flow lists over several lines, numbers, texts, and
tags (`!!opencv-matrix`), which are ignored. No anchors, no block texts, no objects: nothing is ever run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

_LARGEST_TEXT = 1 << 20
_DEEPEST = 20
_KEY = re.compile(r"^(\"[^\"]*\"|'[^']*'|[^:#\[\]{},\"']+):(?:\s+(.*))?$")
_TOKEN = re.compile(r"\s*([\[\],]|\"[^\"]*\"|'[^']*'|[^\[\],\s][^\[\],]*)")


@dataclass(frozen=True)
class _Line:
    number: int
    indent: int
    text: str


def parse_yaml(text: str) -> Any:
    """Mappings, lists, floats and texts of a YAML text.

    Raises:
        ValueError: something that this part of YAML does not have; the message names the line.
    """
    if len(text) > _LARGEST_TEXT:
        raise ValueError(f"it is larger than {_LARGEST_TEXT} characters")
    lines = _joined(_lines(text))
    if not lines:
        return {}
    value, rest = _block(lines, 0, lines[0].indent, 0)
    if rest < len(lines):
        raise ValueError(f"line {lines[rest].number} is indented in a way that is not understood")
    return value


def _lines(text: str) -> list[_Line]:
    found = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = _without_comment(raw.replace("\t", "    ")).rstrip()
        if line.strip() and not line.startswith(("%", "---", "...")):
            found.append(_Line(number, len(line) - len(line.lstrip()), line.strip()))
    return found


def _without_comment(line: str) -> str:
    quote = ""
    for place, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character == "#" and (place == 0 or line[place - 1] in " \t"):
            return line[:place]
    return line


def _joined(lines: list[_Line]) -> list[_Line]:
    """Lines of which a flow list that goes on is one."""
    joined: list[_Line] = []
    open_brackets = 0
    for line in lines:
        if open_brackets > 0:
            last = joined[-1]
            joined[-1] = _Line(last.number, last.indent, f"{last.text} {line.text}")
        else:
            joined.append(line)
        open_brackets += line.text.count("[") - line.text.count("]")
    if open_brackets > 0:
        raise ValueError(f"the list in line {joined[-1].number} is not closed")
    return joined


def _block(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """The value that begins at a line of an indentation, and the line after it."""
    if depth > _DEEPEST:
        raise ValueError(f"line {lines[at].number} is nested too deeply")
    if lines[at].text == "-" or lines[at].text.startswith("- "):
        return _items(lines, at, indent, depth)
    mapping: dict[str, Any] = {}
    while at < len(lines) and lines[at].indent == indent:
        line = lines[at]
        match = _KEY.match(line.text)
        if match is None:
            raise ValueError(f"line {line.number} is no 'name: value'")
        key = match[1].strip().strip("\"'")
        if key in mapping:
            raise ValueError(f"{key!r} appears twice, again in line {line.number}")
        value = re.sub(r"^!\S+\s*", "", (match[2] or "").strip())
        at += 1
        if value:
            mapping[key] = _value(value, line.number)
        elif at < len(lines) and _belongs(lines[at], indent):
            mapping[key], at = _block(lines, at, lines[at].indent, depth + 1)
        else:
            mapping[key] = ""
    return mapping, at


def _belongs(line: _Line, indent: int) -> bool:
    """Whether a line is inside of what began at an indentation; lists may begin at the same one."""
    return line.indent > indent or (line.indent == indent and line.text.startswith("- "))


def _items(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[list[Any], int]:
    items = []
    while at < len(lines) and lines[at].indent == indent and lines[at].text.startswith("-"):
        inner = lines[at].text[1:].strip()
        line = lines[at]
        at += 1
        if not inner:
            raise ValueError(f"line {line.number} is an empty item")
        if _KEY.match(inner) and not inner.startswith("["):
            column = indent + len(line.text) - len(inner)
            part = [_Line(line.number, column, inner)]
            while at < len(lines) and lines[at].indent > indent:
                part.append(lines[at])
                at += 1
            value, rest = _block(part, 0, column, depth + 1)
            if rest < len(part):
                raise ValueError(f"line {part[rest].number} is indented in a way that is not understood")
            items.append(value)
        else:
            items.append(_value(inner, line.number))
    return items, at


def _value(text: str, number: int) -> Any:
    """A flow list, a number or a text."""
    if not text.startswith("["):
        return _scalar(text)
    stack: list[list[Any]] = [[]]
    place = 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            break
        place = match.end()
        token = match[1]
        if token == "[":
            if len(stack) > _DEEPEST:
                raise ValueError(f"line {number} is nested too deeply")
            stack.append([])
        elif token == "]":
            if len(stack) < 2:
                raise ValueError(f"line {number} closes a list that is not open")
            closed = stack.pop()
            stack[-1].append(closed)
        elif token != ",":
            stack[-1].append(_scalar(token.strip()))
    if len(stack) != 1 or len(stack[0]) != 1 or text[place:].strip():
        raise ValueError(f"the list in line {number} is not understood")
    return stack[0][0]


def _scalar(text: str) -> Any:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    try:
        return float(text)
    except ValueError:
        return text
