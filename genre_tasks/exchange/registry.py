"""Formats by name and by file name; each is imported when it is first used."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import NamedTuple, cast

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.types import ExchangeFormat
from genre_tasks.suggestions import did_you_mean


class FormatEntry(NamedTuple):
    """Where to find a format.

    Attributes:
        target: ``"module:constant"``, an ``ExchangeFormat``.
        suffixes: ends of file names, in lower case.
        install_hint: what to install if importing the module fails.
    """

    target: str
    suffixes: tuple[str, ...]
    install_hint: str = "pip install genre"


# Targets are text: importing all formats would load OpenUSD for a PLY file.
# A longer suffix comes before a shorter one that it ends with.
_FORMATS: dict[str, FormatEntry] = {
    "compressed.ply": FormatEntry("genre_tasks.exchange.compressed_ply:COMPRESSED_PLY", (".compressed.ply",)),
    "ply": FormatEntry("genre_tasks.exchange.ply:PLY", (".ply",)),
    "splat": FormatEntry("genre_tasks.exchange.antimatter_splat:SPLAT", (".splat",)),
    "spz": FormatEntry("genre_tasks.exchange.spz.format:SPZ", (".spz",)),
    "glb": FormatEntry("genre_tasks.exchange.gltf.format:GLB", (".glb",)),
    "usdz": FormatEntry(
        "genre_tasks.exchange.usd.format:USDZ", (".usdz", ".usdc", ".usda", ".usd"), "pip install 'genre[usd]'"
    ),
}


def known_formats() -> tuple[str, ...]:
    """Lists the names of formats.

    >>> known_formats()
    ('compressed.ply', 'ply', 'splat', 'spz', 'glb', 'usdz')
    """
    return tuple(_FORMATS)


def list_format_modules() -> tuple[str, ...]:
    """Lists the modules that formats are in, each once.

    >>> list_format_modules()[:2]
    ('genre_tasks.exchange.compressed_ply', 'genre_tasks.exchange.ply')
    """
    return tuple(dict.fromkeys(entry.target.partition(":")[0] for entry in _FORMATS.values()))


def load_format(name: str) -> ExchangeFormat:
    """Loads a format by its name.

    Args:
        name: one of :func:`known_formats`.

    Returns:
        The format.

    Raises:
        ConfigError: no format has that name, or its package is not installed.
    """
    entry = _FORMATS.get(name)
    if entry is None:
        remedy = f"{did_you_mean(name, _FORMATS)}Known: {', '.join(_FORMATS)}."
        raise ConfigError(f"unknown format '{name}'", remedy=remedy)
    module, _, constant = entry.target.partition(":")
    try:
        loaded = getattr(importlib.import_module(module), constant)
    except ModuleNotFoundError as error:
        # A missing module of our own is a fault, and no package to install.
        if (error.name or "").startswith("genre_tasks"):
            raise
        raise ConfigError(
            f"the format {name} needs the package {error.name}", remedy=f"Install it: {entry.install_hint}."
        ) from error
    return cast(ExchangeFormat, loaded)


def find_format(path: Path) -> ExchangeFormat:
    """Finds the format of a file by its name.

    Args:
        path: of the file, which need not exist.

    Returns:
        The format.

    Raises:
        InputError: the name has no known suffix.
        ConfigError: the format's package is not installed.
    """
    for name, entry in _FORMATS.items():
        if path.name.lower().endswith(entry.suffixes):
            return load_format(name)
    suffixes = ", ".join(suffix for entry in _FORMATS.values() for suffix in entry.suffixes)
    raise InputError("the file's name has no known suffix", remedy=f"Known are {suffixes}.", file=path)
