"""Tables that several commands print."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_fields(title: str, fields: Mapping[str, Any]) -> None:
    """Name and value, a row each; nested values as indented lines."""
    console = Console()
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for name, value in fields.items():
        table.add_row(name.replace("_", " "), Text(_text(value)))
    console.print(table)


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """One row per mapping; the columns are the keys of the first."""
    console = Console()
    table = Table(title=title, title_justify="left")
    for name in rows[0] if rows else ["nothing yet"]:
        table.add_column(name.replace("_", " "), overflow="fold")
    for row in rows:
        table.add_row(*(Text(_text(v)) for v in row.values()))
    console.print(table)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        if not value:
            return "none"
        parts = [(k, _text(v), isinstance(v, Mapping) and len(v) > 0) for k, v in value.items()]
        return "\n".join(f"{k}:\n{textwrap.indent(v, '  ')}" if nested else f"{k}: {v}" for k, v, nested in parts)
    if isinstance(value, list | tuple):
        scalars = all(not isinstance(v, Mapping | list | tuple) for v in value)
        return (", " if scalars and len(str(value)) < 90 else "\n").join(
            ", ".join(f"{k} {_text(w)}" for k, w in v.items()) if isinstance(v, Mapping) else _text(v) for v in value
        )
    return str(value)
