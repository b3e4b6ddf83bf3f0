"""Tables that several commands print; where they do not fit into the terminal, the same as lines."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from rich import box as boxes
from rich.box import Box
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from flows.cli.streams import terminal_width

_MAX_LIST_WIDTH = 90
"""A list of plain values that is longer than this many characters has a line for each value."""
_READABLE_WIDTH = 16
"""A column that holds longer words, such as keys and paths, may fold them at this many characters."""


def make_console() -> Console:
    """Makes the console that every command prints to.

    Returns:
        One as wide as the terminal, that takes brackets and colons of names and paths as they are.
    """
    # With a height, as Rich takes any terminal that it does not know for 80 columns otherwise.
    return Console(width=terminal_width(sys.stdout), height=25, markup=False, emoji=False)


def print_fields(title: str, fields: Mapping[str, Any]) -> None:
    """Prints names and values, a row each; nested values are indented lines.

    Args:
        title: written above the table.
        fields: value by name; underscores in names become spaces.
    """
    console = make_console()
    rows = [(name.replace("_", " "), format_value(value)) for name, value in fields.items()]
    if _fits(console, ("", ""), rows, boxes.HEAVY_HEAD):
        console.print(_build_table(title, ("", ""), rows, boxes.HEAVY_HEAD, show_header=False))
        return
    _print_line(console, title)
    for name, text in rows:
        _print_entry(console, name, text)


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a table with one row for each mapping.

    Args:
        title: written above the table.
        rows: mappings with the same keys; the keys of the first one are the headings.
    """
    headings = [name.replace("_", " ") for name in rows[0]] if rows else ["nothing yet"]
    print_table(title, headings, [[format_value(value) for value in row.values()] for row in rows])


def print_table(
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    right: Collection[str] = (),
    box: Box = boxes.HEAVY_HEAD,
) -> None:
    """Prints a table; where the terminal is too narrow for its words, a line for each cell.

    Args:
        title: written above the table.
        headings: of the columns.
        rows: of as many cells as there are headings.
        right: headings of the columns that are aligned to the right.
        box: how the table is framed.
    """
    console = make_console()
    if _fits(console, headings, rows, box):
        console.print(_build_table(title, headings, rows, box, right))
        return
    _print_line(console, title)
    for row in rows:
        for heading, text in zip(headings, row, strict=True):
            _print_entry(console, heading, text)
        console.print()


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


def _build_table(
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    box: Box,
    right: Collection[str] = (),
    show_header: bool = True,
) -> Table:
    table = Table(
        title=Text(title) if title else None,
        title_justify="left",
        show_header=show_header,
        box=box,
        # The open frame has no lines that would hold columns apart, so that one blank is enough.
        padding=(0, 1, 0, 0) if box is boxes.SIMPLE else (0, 1),
    )
    for heading, width in zip(headings, _word_widths(headings, rows), strict=True):
        justify = "right" if heading in right else "left"
        # Folded and not cut off: keys and paths are there to be copied.
        table.add_column(Text(heading), justify=justify, overflow="fold", min_width=width)  # type: ignore[arg-type]
    for row in rows:
        # Text and not str: a value like [bold] would otherwise be read as markup.
        table.add_row(*(Text(cell) for cell in row))
    return table


def _word_widths(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    """How wide each column must be at least, so that no word of a usual length is broken."""
    columns = [[heading, *cells] for heading, *cells in zip(headings, *rows, strict=True)]
    widths = [max((cell_len(word) for cell in column for word in cell.split()), default=1) for column in columns]
    return [min(width, _READABLE_WIDTH) for width in widths]


def _fits(console: Console, headings: Sequence[str], rows: Sequence[Sequence[str]], box: Box) -> bool:
    """Whether the terminal has room for every column at the least width at which it can be read."""
    probe = _build_table("", ["x" * width for width in _word_widths(headings, rows)], [], box)
    needed = Measurement.get(console, console.options.update(max_width=10_000), probe).minimum
    return needed <= console.width


def _print_entry(console: Console, name: str, text: str) -> None:
    separator = "\n" if "\n" in text else " "
    body = textwrap.indent(text, "  ") if "\n" in text else text
    _print_line(console, f"{name}:{separator}{body}" if name else body)


def _print_line(console: Console, text: str) -> None:
    console.print(Text(text, overflow="fold"))
