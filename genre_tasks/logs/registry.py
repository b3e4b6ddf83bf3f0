"""Readers of driving logs by name: ``open_log("pandaset:PATH/002")``.

A reader is a function ``open(rest: str) -> DrivingLog``, given as ``"module:function"`` and imported when first used.
"""

from __future__ import annotations

import difflib
import importlib
from dataclasses import dataclass

from genre_tasks.errors import InputError
from genre_tasks.logs.types import DrivingLog


@dataclass(frozen=True)
class ReaderEntry:
    """Where a reader lives, an example of its URI, and what to install if the import fails."""

    target: str
    example: str
    hint: str


_READERS: dict[str, ReaderEntry] = {
    "pandaset": ReaderEntry(
        "genre_tasks.logs.pandaset.reader:open_pandaset",
        "pandaset:PATH/002",
        "pip install genre (pillow is part of it)",
    ),
    "synthetic": ReaderEntry(
        "genre_tasks.logs.synthetic:open_synthetic",
        "synthetic:street?seed=1000",
        "pip install trimesh embreex (the street is ray-cast with Embree)",
    ),
}


def register(name: str, target: str, hint: str, example: str = "") -> None:
    """Adds a reader: ``target`` is ``"module:function"``, ``hint`` what to install if importing it fails."""
    if name in _READERS and _READERS[name].target != target:
        raise ValueError(f"the reader {name!r} exists already, at {_READERS[name].target}")
    _READERS[name] = ReaderEntry(target, example or f"{name}:…", hint)


def known_readers() -> tuple[str, ...]:
    """The names that ``open_log`` understands, sorted."""
    return tuple(sorted(_READERS))


def open_log(uri: str) -> DrivingLog:
    """Opens ``reader:rest``; cheap, nothing but small files is read.

    Raises:
        InputError: no or an unknown reader, a reader whose packages are not installed, or what the reader itself says
            about ``rest`` (no such path, …).
    """
    name, colon, rest = uri.partition(":")
    entry = _READERS.get(name)
    if not colon or entry is None:
        raise InputError(_unknown(uri, name, bool(colon)), remedy=_remedy(name), log=uri)
    module_name, _, function = entry.target.partition(":")
    try:
        reader = getattr(importlib.import_module(module_name), function)
    except ImportError as error:
        raise InputError(
            f"the reader {name!r} cannot be loaded ({error})", remedy=f"Install what it needs: {entry.hint}.", log=uri
        ) from error
    log: DrivingLog = reader(rest)
    return log


def _unknown(uri: str, name: str, has_colon: bool) -> str:
    if not has_colon:
        return f"a log is given as reader:where, {uri!r} names no reader"
    return f"unknown reader {name!r}"


def _remedy(name: str) -> str:
    close = difflib.get_close_matches(name, _READERS, n=1)
    question = f"Did you mean {close[0]!r}? " if close else ""
    return question + "Known: " + ", ".join(_READERS[n].example for n in known_readers()) + "."
