"""Reads YAML that a person wrote: words, numbers, lists and mappings as they are written, and one line for a mistake.

The values are those of YAML 1.2's core schema, in decimal digits only: ``on`` is a word, ``010`` is ten, ``1:30`` is a
word and ``1e5`` is a number. What could surprise is refused: tags, anchors and aliases, merge keys, duplicate keys,
further documents, and nesting deeper than any configuration has.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from genre_tasks.errors import ConfigError

MAX_BYTES = 200_000
"""Files are refused above this size; a configuration has a few thousand bytes."""

MAX_DEPTH = 32
"""Lists and mappings may be nested this deep; a configuration has four levels."""

NULLS = ("", "~", "null", "Null", "NULL")
"""The words for no value."""

_MAX_DIGITS = 400
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INTEGER = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITY = re.compile(r"([-+]?)\.(inf|Inf|INF)")
_NOT_A_NUMBER = (".nan", ".NaN", ".NAN")

KeyPath = tuple[str, ...]


class YamlError(ValueError):
    """A text is no YAML of the kind that this module reads.

    Args:
        problem: what is wrong, one line without a full stop.
        line: the line of the text, from 1.
    """

    def __init__(self, problem: str, line: int) -> None:
        super().__init__(f"line {line}: {problem}")
        self.problem = problem
        self.line = line


@dataclass(frozen=True)
class YamlMapping:
    """The mapping that a file holds.

    Attributes:
        values: plain values by key.
        lines: the line in which each key stands, from 1, by the keys that lead to it.
        texts: the text of each value that is a number, by the same keys: a name such as 0012 or 77e2 looks like one.
    """

    values: dict[str, Any]
    lines: Mapping[KeyPath, int]
    texts: Mapping[KeyPath, str]


def parse_yaml(text: str) -> Any:
    """Reads a value from YAML.

    Args:
        text: one document.

    Returns:
        ``None``, a bool, int, float or str, or lists and dicts of them; ``None`` for an empty text.

    Raises:
        YamlError: the text is no YAML, or uses what this module refuses.

    >>> parse_yaml("[010, 1e5, on, 1:30]")
    [10, 100000, 'on', '1:30']
    >>> parse_yaml("{a: 1, a: 2}")
    Traceback (most recent call last):
    flows.yaml_values.YamlError: line 1: the key 'a' is there twice, the first time in line 1
    """
    return _parse(text).value


def read_yaml_mapping(path: Path, about: str, expected: str, remedy: str) -> YamlMapping:
    """Reads a YAML file that holds a mapping.

    Args:
        path: the file; a leading ``~`` is the user's home folder.
        about: what the file is, for errors, such as ``configuration file``.
        expected: what it holds, for errors, such as ``sections``.
        remedy: what to do where the file is missing, unreadable or no mapping.

    Returns:
        Its values and where they stand; an empty file is an empty mapping.

    Raises:
        ConfigError: the file cannot be read or is no such YAML; the error names the file and the line.
    """
    text = read_text(path, about, remedy)
    try:
        parsed = _parse(text)
    except YamlError as error:
        raise ConfigError(f"the file is not YAML: {error}", remedy="Mend that line.", file=path) from error
    # An empty file is no mistake: it changes nothing.
    if parsed.value is None:
        return YamlMapping({}, {}, {})
    if not isinstance(parsed.value, dict):
        raise ConfigError(f"expected {expected} at the top level", remedy=remedy, file=path)
    return YamlMapping(parsed.value, parsed.lines, parsed.texts)


def read_text(path: Path, about: str, remedy: str) -> str:
    """Reads a small text file in UTF-8, with or without a byte-order mark.

    Args:
        path: the file; a leading ``~`` is the user's home folder.
        about: what the file is, for errors.
        remedy: what to do where the file is missing or unreadable.

    Returns:
        The text.

    Raises:
        ConfigError: the file is missing, unreadable, too large or in another encoding.
    """
    try:
        with path.expanduser().open("rb") as stream:
            # Bounded, as the path may name a device that never ends.
            data = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"the {about} cannot be read: {reason}", remedy=remedy, file=path) from error
    if len(data) > MAX_BYTES:
        raise ConfigError(f"the {about} has more than {MAX_BYTES} bytes", remedy=remedy, file=path)
    encode = "Save it as UTF-8."
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in data[:4]:
        raise ConfigError(f"the {about} is text in UTF-16 or UTF-32, or no text", remedy=encode, file=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        problem = f"the {about} is no text in UTF-8: line {line} has the byte 0x{data[error.start]:02X}"
        raise ConfigError(problem, remedy=encode, file=path) from error


class _Composer(yaml.BaseLoader):
    """Composes nodes, and refuses what has a meaning beyond plain values."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        line = event.start_mark.line + 1
        # An alias can repeat a list of aliases, and a few lines of them would fill the memory.
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise YamlError("anchors and aliases (& and *) are not supported; quote a word that begins so", line)
        if event.tag is not None:
            raise YamlError("tags (!) are not supported; quote a word that begins so", line)
        # The composer calls itself for every level, and Python's stack ends at a thousand.
        if self._depth == MAX_DEPTH:
            raise YamlError(f"lists or mappings are nested more than {MAX_DEPTH} deep", line)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


@dataclass
class _Parsed:
    """A value, the line of each key in it, and the text of each number."""

    value: Any
    lines: dict[KeyPath, int]
    texts: dict[KeyPath, str]


def _parse(text: str) -> _Parsed:
    try:
        composer = _Composer(text)
        node = composer.get_single_node()
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise YamlError(f"the character U+{ord(text[error.position]):04X} is not allowed", line) from None
    except yaml.MarkedYAMLError as error:
        raise _translate(error) from None
    parsed = _Parsed(None, {}, {})
    if node is not None:
        parsed.value = _to_plain(node, (), parsed)
    return parsed


def _translate(error: yaml.MarkedYAMLError) -> YamlError:
    line = error.problem_mark.line + 1 if error.problem_mark else 1
    problem = str(error.problem).replace("'<stream end>'", "the end")
    if problem == "but found another document":
        return YamlError("a second document begins here; keep one", line)
    # A bracket that is never closed shows at the end of the file: where it was opened helps more.
    if error.context and error.context_mark and error.context_mark.line + 1 != line:
        problem += f" ({error.context} that begins in line {error.context_mark.line + 1})"
    return YamlError(problem, line)


def _to_plain(node: yaml.Node, path: KeyPath, parsed: _Parsed) -> Any:
    if isinstance(node, yaml.MappingNode):
        return _to_dict(node, path, parsed)
    if isinstance(node, yaml.SequenceNode):
        return [_to_plain(item, (*path, str(index)), parsed) for index, item in enumerate(node.value)]
    # Quotes and block styles say that a value is text.
    if isinstance(node, yaml.ScalarNode) and node.style:
        return node.value
    value = _parse_scalar(node.value, node.start_mark.line + 1)
    if isinstance(value, int | float) and not isinstance(value, bool):
        parsed.texts[path] = str(node.value)
    return value


def _to_dict(node: yaml.MappingNode, path: KeyPath, parsed: _Parsed) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise YamlError("a key is a list or a mapping; keys are words", line)
        # As written, whatever it would be as a value: keys are names.
        key = str(key_node.value)
        if key == "<<" and not key_node.style:
            raise YamlError("merge keys (<<) are not supported; write the keys out", line)
        if key in values:
            first = parsed.lines[*path, key]
            raise YamlError(f"the key {key!r} is there twice, the first time in line {first}", line)
        parsed.lines[*path, key] = line
        values[key] = _to_plain(value_node, (*path, key), parsed)
    return values


def _parse_scalar(text: str, line: int) -> Any:
    """A plain scalar by YAML 1.2's core schema, without its octal and hexadecimal numbers."""
    if text in NULLS:
        return None
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if match := _INFINITY.fullmatch(text):
        return float(f"{match[1]}inf")
    if text in _NOT_A_NUMBER:
        return float("nan")
    if not _FLOAT.fullmatch(text):
        return text
    # Python itself refuses to convert many more digits, as that takes long.
    if len(text) > _MAX_DIGITS:
        raise YamlError(f"a number has {len(text)} digits", line)
    if _INTEGER.fullmatch(text):
        return int(text)
    number = float(text)
    # 1e5 is how people write a large whole number; 100000.0 says that fractions are meant.
    is_whole = "e" in text.lower() and number.is_integer() and abs(number) <= 2**53
    return int(number) if is_whole else number
