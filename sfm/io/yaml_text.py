"""The part of YAML that calibration files are written in.

Block mappings and sequences, flow lists and mappings over several lines, quoted and plain scalars, comments, `---`,
and tags, which are passed over (`!!opencv-matrix`). OpenCV's dialect, `%YAML:1.0`, is included. Anchors, aliases,
block scalars (`|`, `>`) and scalars that go on in the next line are refused: no program writes calibrations with them.
"""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
_INTEGER = re.compile(r"[-+]?\d+$")
_WORDS: dict[str, Any] = {"": None, "~": None, "null": None, "true": True, "false": False}
_NOT_FINITE = {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf, ".nan": math.nan, "nan": math.nan}
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "0": "\0", '"': '"', "\\": "\\", "/": "/"}
_DEEPEST = 40


@dataclasses.dataclass(slots=True)
class _Line:
    number: int
    indent: int
    text: str


def parse_yaml(text: str) -> Any:
    """The document as dictionaries, lists, texts, numbers, truth values and None.

    Raises:
        ValueError: it is not YAML, or uses more of it than this reader knows; the line is named.
    """
    lines = _logical_lines(text.removeprefix("\ufeff"))
    if not lines:
        return None
    value, at = _block(lines, 0, lines[0].indent, 0)
    if at < len(lines):
        raise _error(lines[at], "is indented otherwise than the lines above")
    return value


def _error(line: _Line, cause: str) -> ValueError:
    return ValueError(f"line {line.number} {cause}")


# Lines


def _logical_lines(text: str) -> list[_Line]:
    """Lines without comments; a flow list or mapping that goes on is one line with where it began."""
    lines: list[_Line] = []
    open_brackets = 0
    for number, raw in enumerate(text.splitlines(), 1):
        if not open_brackets and (raw.startswith(("%", "---")) or not raw.strip()):
            rest = raw[3:].strip() if raw.startswith("---") else ""
            if rest and not rest.startswith("#"):
                lines.append(_Line(number, 0, rest))
            continue
        if raw.startswith("...") and not open_brackets:
            break
        content, balance = _without_comment(raw)
        if not content.strip():
            continue
        if open_brackets:
            lines[-1].text += " " + content.strip()
        else:
            indent = len(content) - len(content.lstrip(" "))
            if content[indent] == "\t":
                raise _error(_Line(number, 0, ""), "is indented by a tab")
            lines.append(_Line(number, indent, content.strip()))
        open_brackets += balance
        if open_brackets < 0:
            raise _error(lines[-1], "closes a bracket that is not open")
    if open_brackets:
        raise _error(lines[-1], "opens a bracket that is not closed")
    return lines


def _without_comment(raw: str) -> tuple[str, int]:
    """The line up to its comment, and by how many brackets outside quotes it opens more than it closes."""
    quote, balance, before = "", 0, " "
    for k, character in enumerate(raw):
        if quote:
            if character == quote and not (quote == '"' and before == "\\"):
                quote = ""
        elif character in "\"'" and before in " \t[{,:":
            quote = character
        elif character == "#" and before in " \t":
            return raw[:k].rstrip(), balance
        else:
            balance += (character in "[{") - (character in "]}")
        before = character
    return raw.rstrip(), balance


# Blocks


def _block(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """The value that begins in a line, and the line behind it."""
    if depth > _DEEPEST:
        raise _error(lines[at], "is nested too deep")
    line = lines[at]
    if _is_item(line.text):
        return _sequence(lines, at, indent, depth)
    if _key_end(line.text) >= 0:
        return _mapping(lines, at, indent, depth)
    return _inline(line.text, line), at + 1


def _sequence(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[list[Any], int]:
    items = []
    while at < len(lines) and lines[at].indent == indent and _is_item(lines[at].text):
        line = lines[at]
        rest = _without_tag(line.text[1:].lstrip(" "))
        if rest:
            # What follows the dash stands where a line of its own would.
            lines[at] = _Line(line.number, indent + len(line.text) - len(rest), rest)
            value, at = _block(lines, at, lines[at].indent, depth + 1)
        else:
            value, at = _below(lines, at + 1, indent, depth)
        items.append(value)
    return items, at


def _mapping(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[dict[str, Any], int]:
    values: dict[str, Any] = {}
    while at < len(lines) and lines[at].indent == indent and not _is_item(lines[at].text):
        line = lines[at]
        end = _key_end(line.text)
        if end < 0:
            raise _error(line, "is neither a key nor an item of a list")
        key = str(_scalar(line.text[:end].strip(), line))
        if key in values:
            raise _error(line, f"has the key {key!r} for the second time")
        rest = _without_tag(line.text[end + 1 :].strip())
        if rest:
            values[key], at = _inline(rest, line), at + 1
        elif at + 1 < len(lines) and lines[at + 1].indent == indent and _is_item(lines[at + 1].text):
            values[key], at = _sequence(lines, at + 1, indent, depth + 1)
        else:
            values[key], at = _below(lines, at + 1, indent, depth)
    return values, at


def _below(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """The block of lines that are farther to the right; None where there is none."""
    if at < len(lines) and lines[at].indent > indent:
        return _block(lines, at, lines[at].indent, depth + 1)
    return None, at


def _is_item(text: str) -> bool:
    return text == "-" or text.startswith("- ")


def _key_end(text: str) -> int:
    """Where the colon behind a key is; −1 where the line is no key."""
    if text[0] in "[{":
        return -1
    if text[0] in "\"'":
        end = text.find(text[0], 1) + 1
        return end if end and text[end : end + 1] == ":" else -1
    match = re.search(r":(?= |$)", text)
    return match.start() if match else -1


def _without_tag(text: str) -> str:
    return re.sub(r"^!\S*\s*", "", text)


# Values in a line


def _inline(text: str, line: _Line) -> Any:
    text = _without_tag(text)
    if text[:1] not in ("[", "{"):
        return _scalar(text, line)
    value, at = _flow(text, 0, line, 0)
    if text[at:].strip():
        raise _error(line, f"goes on behind its last bracket: {text[at:].strip()[:20]!r}")
    return value


def _flow(text: str, at: int, line: _Line, depth: int) -> tuple[Any, int]:
    """The list, mapping or scalar at a place of the line, and the place behind it."""
    if depth > _DEEPEST:
        raise _error(line, "is nested too deep")
    if text[at] not in "[{":
        end = _scalar_end(text, at)
        return _scalar(_without_tag(text[at:end].strip()), line), end
    is_list, close = text[at] == "[", {"[": "]", "{": "}"}[text[at]]
    items: list[Any] = []
    values: dict[str, Any] = {}
    at = _skip(text, at + 1)
    while text[at : at + 1] != close:
        if at >= len(text):
            raise _error(line, "has brackets of different kinds")
        value, at = _flow(text, at, line, depth + 1)
        at = _skip(text, at)
        if is_list:
            items.append(value)
        elif text[at : at + 1] == ":":
            at = _skip(text, at + 1)
            empty = text[at : at + 1] in (",", "}", "")
            values[str(value)], at = (None, at) if empty else _flow(text, at, line, depth + 1)
            at = _skip(text, at)
        else:
            raise _error(line, f"has no value for {value!r}")
        if text[at : at + 1] == ",":
            at = _skip(text, at + 1)
        elif text[at : at + 1] != close:
            raise _error(line, "has brackets of different kinds")
    return (items if is_list else values), at + 1


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at] == " ":
        at += 1
    return at


def _scalar_end(text: str, at: int) -> int:
    if text[at] in "\"'":
        end = text.find(text[at], at + 1)
        while text[at] == '"' and end > 0 and text[end - 1] == "\\":
            end = text.find('"', end + 1)
        return end + 1 if end >= 0 else len(text)
    match = re.compile(r"[,\[\]{}]|:(?=[ ,}]|$)").search(text, at)
    return match.start() if match else len(text)


def _scalar(text: str, line: _Line) -> Any:
    if text[:1] in ("&", "*", "|", ">", "@", "`"):
        raise _error(line, f"uses {text[0]!r}, which this reader of YAML does not know")
    if text[:1] in ('"', "'"):
        if len(text) < 2 or text[-1] != text[0]:
            raise _error(line, "has a quote that is not closed")
        if text[0] == "'":
            return text[1:-1].replace("''", "'")
        return re.sub(r"\\(.)", lambda m: _ESCAPES.get(m.group(1), m.group(0)), text[1:-1])
    lower = text.lower()
    if lower in _WORDS or lower in _NOT_FINITE:
        return _WORDS.get(lower, _NOT_FINITE.get(lower))
    if _INTEGER.match(text):
        return int(text)
    return float(text) if _NUMBER.match(text) else text
