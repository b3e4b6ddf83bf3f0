"""Exporters by the name of their format: those of single files, and those that write a folder of their own kind."""

from __future__ import annotations

import importlib
from typing import cast

from flows.exchange.export_request import SceneExporter
from flows.exchange.file_exporter import FileExporter
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.registry import known_formats, load_format
from genre_tasks.suggestions import did_you_mean

# Name of a format → "module:constant", a ``SceneExporter``. Formats of single files need no line here.
_FOLDER_EXPORTERS: dict[str, str] = {
    "alpasim": "flows.simulators.alpasim.exporter:ALPASIM",
}

_READ_ONLY = ("compressed.ply",)


def list_export_formats() -> tuple[str, ...]:
    """Lists what ``--format`` takes.

    >>> "ply" in list_export_formats()
    True
    """
    return (*(name for name in known_formats() if name not in _READ_ONLY), *_FOLDER_EXPORTERS)


def load_exporter(name: str) -> SceneExporter:
    """Loads the exporter of a format.

    Args:
        name: one of :func:`list_export_formats`.

    Returns:
        The exporter.

    Raises:
        ConfigError: no format has that name, it is only read, or its package is not installed.
    """
    target = _FOLDER_EXPORTERS.get(name)
    if target is not None:
        module, _, constant = target.partition(":")
        return cast(SceneExporter, getattr(importlib.import_module(module), constant))
    known = list_export_formats()
    if name in known:
        return FileExporter(load_format(name))
    problem = f"the format {name} is only read" if name in _READ_ONLY else f"unknown format '{name}'"
    raise ConfigError(problem, remedy=f"{did_you_mean(name, known)}--format takes {', '.join(known)}.")
