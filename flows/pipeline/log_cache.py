"""The logs and chunks that a run is about: opened once, selected, expanded."""

from __future__ import annotations

import functools
import glob
import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from flows.pipeline.log_lists import expand_log_list
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import InputError
from genre_tasks.user_paths import expand_user_path

if TYPE_CHECKING:
    from genre_tasks.logs.types import DrivingLog


# Four: a run has one log, and a sweep goes through its chunks log by log. More would only hold memory.
@functools.lru_cache(maxsize=4)
def cached_log(uri: str) -> DrivingLog:
    """Opens a log once for each process; later calls give the same object.

    Args:
        uri: the log's reader and address, such as ``pandaset:PATH/002`` or ``synthetic:street?seed=1000``.

    Returns:
        The opened log.

    Raises:
        InputError: the log cannot be opened.
        ConfigError: no reader is called that.

    >>> log = cached_log("synthetic:street?seed=1000&frames=8")
    >>> log.frame_count
    8
    >>> log is cached_log("synthetic:street?seed=1000&frames=8")
    True
    """
    from genre_tasks.logs.registry import open_log

    return open_log(uri)


def select_chunks(log: str, config: PipelineConfig, chunks: list[int] | None) -> list[int]:
    """Checks the chunks that the user asked for.

    Args:
        log: the log's URI.
        config: its section ``ingest`` says how long a chunk is.
        chunks: numbers of chunks, from 0; ``None`` for all chunks of the log that are long enough.

    Returns:
        The numbers of the chunks to run.

    Raises:
        InputError: the log does not have one of the chunks, one is chosen twice, or there is none.

    >>> select_chunks("synthetic:street?seed=1000&frames=30", PipelineConfig(), None)
    [0, 1]
    >>> select_chunks("synthetic:street?seed=1000&frames=22", PipelineConfig(), None)
    [0]
    """
    from genre_tasks.logs.log_selection import chunk_count, has_short_tail

    count = chunk_count(config.ingest, cached_log(log))
    if count == 0:
        raise InputError("the log has no frames", remedy="Copy it again, or choose another one.", log=log)
    known = f"Chunks are 0 to {count - 1}."
    # Who names the last chunk is told why it cannot be used; otherwise the other chunks are what is wanted.
    usable_count = count - has_short_tail(config.ingest, cached_log(log))
    selected = list(range(usable_count)) if chunks is None else chunks
    # None of these does anything that could be wanted, and a run of nothing would count as done.
    if not isinstance(selected, list | tuple) or not selected:
        raise InputError("no chunk is chosen", remedy=known, log=log)
    for position, chunk in enumerate(selected):
        # All are checked before the first one is computed, as that takes minutes. A flow's parameters may be anything.
        if not isinstance(chunk, int) or isinstance(chunk, bool) or not 0 <= chunk < count:
            raise InputError(f"there is no chunk {chunk}", remedy=known, log=log)
        if chunk in selected[:position]:
            raise InputError(f"chunk {chunk} is chosen twice", remedy="Name each chunk once.", log=log)
    return list(selected)


def expand_logs(logs: list[str]) -> list[str]:
    """Replaces every ``reader:PATH/*`` by one URI for each log that matches, and ``reader:PATH/@FILE`` by a list.

    Args:
        logs: URIs of logs, with or without stars in the path; ``~`` is the home folder. FILE holds one name a line.

    Returns:
        URIs without stars, in the order of ``logs``; those of a star are sorted by name.

    Raises:
        InputError: a star matches no log; or ``~NAME`` names no user.

    >>> expand_logs(["synthetic:street?seed=1", "pandaset:logs/002"])
    ['synthetic:street?seed=1', 'pandaset:logs/002']
    """
    from genre_tasks.logs.registry import list_logs, quote_path, takes_quoted_paths

    expanded: list[str] = []
    for uri in [name for entry in logs for name in expand_log_list(entry) or [entry]]:
        reader, _, text = uri.partition(":")
        is_quoted = takes_quoted_paths(reader)
        # Other readers take a question mark for a part of the name.
        written, mark, options = text.partition("?") if is_quoted else (text, "", "")
        path = expand_user_path(unquote(written) if is_quoted else written)
        # A folder may really have a star in its name.
        if "*" not in written or path.is_dir():
            expanded.append(uri)
            continue
        # Logs of some layouts are rows of tables, or files beside one another.
        found = list_logs(uri)
        if found is None:
            names = [str(folder) for folder in _match_folders(path)]
            found = [f"{reader}:{quote_path(name) if is_quoted else name}{mark}{options}" for name in names]
        if not found:
            raise InputError(f"no log matches {uri}", remedy="Name a folder that holds sequences.", file=path.parent)
        expanded += found
    return expanded


def _match_folders(path: Path) -> list[Path]:
    start = next(index for index, part in enumerate(path.parts) if "*" in part)
    # Only a star stands for other characters: brackets and question marks are parts of names. Several in a row mean no
    # more than one, but for a part of two alone, which pathlib takes for any number of folders.
    names = [
        part if part == "**" else "*".join(glob.escape(text) for text in re.split(r"\*+", part))
        for part in path.parts[start:]
    ]
    found = Path(*path.parts[:start]).glob("/".join(names))
    # Sorted by name, so that a dataset runs in the same order on every file system. Hidden folders hold no logs.
    return sorted(folder for folder in found if folder.is_dir() and not folder.name.startswith("."))
