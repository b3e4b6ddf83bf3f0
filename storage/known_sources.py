"""What earlier processes found in source files: parsing them takes longer than the rest of a run that is in the store.

An entry goes by the bytes of its file, so that none is ever out of date.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from genre_tasks import source_code
from genre_tasks.atomic_path import atomic_path
from genre_tasks.cache_folder import find_cache_folder
from genre_tasks.errors import ConfigError
from genre_tasks.json_files import read_json_object
from genre_tasks.source_code import KNOWN_SOURCES, Source

# Many times the files of the package: what belongs to files that have changed since goes at some time.
_MOST = 4000


@contextmanager
def remembered_sources() -> Iterator[None]:
    """Brings in what earlier processes know, and leaves what this one adds to later ones.

    A file of the cache that is damaged, or a folder where none can be written, costs time only.
    """
    path = _find_file()
    if path is not None:
        _load(path)
    before = len(KNOWN_SOURCES)
    yield
    if path is not None and len(KNOWN_SOURCES) > before:
        _save(path)


@cache
def _find_file() -> Path | None:
    try:
        return find_cache_folder() / "sources.json"
    except (ConfigError, OSError):
        return None


@cache
def _digest_parser() -> str:
    """Another version of the parser may find something else in the same file."""
    return hashlib.sha256(Path(source_code.__file__).read_bytes()).hexdigest()


@cache
def _load(path: Path) -> None:
    """Once a process."""
    if not path.is_file():
        return
    with suppress(ConfigError, KeyError, TypeError, ValueError):
        values = read_json_object(path, "cache of sources", "Remove it.", kind=ConfigError)
        if values["parser"] == _digest_parser():
            known = {key: _read_entry(entry) for key, entry in values["sources"].items()}
            KNOWN_SOURCES.update(known)


def _read_entry(entry: Any) -> Source:
    digest, imports, cpp_names = entry
    source = Source(digest, tuple(imports), tuple(cpp_names))
    if not all(isinstance(text, str) for text in (digest, *imports, *cpp_names)):
        raise ValueError(f"{entry!r} holds something else than text")
    return source


def _save(path: Path) -> None:
    newest = list(KNOWN_SOURCES.items())[-_MOST:]
    sources = {key: dataclasses.astuple(source) for key, source in newest}
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as part:
            part.write_text(json.dumps({"parser": _digest_parser(), "sources": sources}), encoding="utf-8")
