"""Tables that several commands print."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

_MAX_LIST_WIDTH = 90
"""A list of plain values that is longer than this many characters has a line for each value."""


def print_fields(title: str, fields: Mapping[str, Any]) -> None:
    """Prints names and values, a row each; nested values are indented lines.

    Args:
        title: written above the table.
        fields: value by name; underscores in names become spaces.
    """
    console = Console()
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column()
    # Folded and not cut off: keys and paths are there to be copied.
    table.add_column(overflow="fold")
    for name, value in fields.items():
        table.add_row(name.replace("_", " "), Text(format_value(value)))
    console.print(table)


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a table with one row for each mapping.

    Args:
        title: written above the table.
        rows: mappings with the same keys; the keys of the first one are the headings.
    """
    console = Console()
    table = Table(title=title, title_justify="left")
    for name in rows[0] if rows else ["nothing yet"]:
        table.add_column(name.replace("_", " "), overflow="fold")
    for row in rows:
        # Text and not str: a value like [bold] would otherwise be read as markup.
        table.add_row(*(Text(format_value(value)) for value in row.values()))
    console.print(table)


def format_value(value: Any) -> str:
    """Writes a value for a reader: four digits of a float, lists with commas, mappings as ``key: value`` lines.

    Args:
        value: plain values, lists and mappings of them, nested at will.

    Returns:
        One or more lines.

    >>> format_value(3.14159)
    '3.142'
    >>> format_value({"size": [320, 180], "loss": {"rgb": 0.8}})
    'size: 320, 180\\nloss:\\n  rgb: 0.8'
    """
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return "\n".join(_format_entry(name, entry) for name, entry in value.items()) or "none"
    if isinstance(value, list | tuple):
        # A short list fits on a line; a long one, or one of mappings, is easier to read line by line.
        is_plain = not any(isinstance(entry, Mapping | list | tuple) for entry in value)
        separator = ", " if is_plain and len(str(value)) < _MAX_LIST_WIDTH else "\n"
        return separator.join(_format_list_entry(entry) for entry in value)
    return str(value)


def _format_entry(name: str, value: Any) -> str:
    text = format_value(value)
    if isinstance(value, Mapping) and value:
        return f"{name}:\n{textwrap.indent(text, '  ')}"
    return f"{name}: {text}"


def _format_list_entry(entry: Any) -> str:
    if isinstance(entry, Mapping):
        return ", ".join(f"{name} {format_value(value)}" for name, value in entry.items())
    return format_value(entry)
