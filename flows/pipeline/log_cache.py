"""Which logs and chunks a run is about."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from genre_tasks.config import PipelineConfig
from genre_tasks.errors import InputError

if TYPE_CHECKING:
    from genre_tasks.logs.types import DrivingLog


@functools.lru_cache(maxsize=4)
def opened_log(uri: str) -> DrivingLog:
    """The log behind a URI, opened once per process."""
    from genre_tasks.logs.registry import open_log

    return open_log(uri)


def chosen_chunks(log: str, config: PipelineConfig, chunks: list[int] | None) -> list[int]:
    """The chunks to run, all without a choice. Raises ``InputError`` for one that the log does not have."""
    from genre_tasks.stages.ingest import chunk_count

    count = chunk_count(config.ingest, opened_log(log))
    wanted = list(range(count)) if chunks is None else chunks
    for chunk in wanted:
        if not 0 <= chunk < count:
            raise InputError(f"there is no chunk {chunk}", remedy=f"Chunks are 0 to {count - 1}.", log=log)
    return wanted


def expanded(logs: list[str]) -> list[str]:
    """``reader:PATH/*`` becomes one URI per folder, sorted. Raises ``InputError`` where nothing matches."""
    out: list[str] = []
    for uri in logs:
        reader, _, path = uri.partition(":")
        if not path.endswith("/*"):
            out.append(uri)
            continue
        folders = sorted(p for p in Path(path[:-2]).glob("*") if p.is_dir())
        if not folders:
            raise InputError(f"no log matches {uri}", remedy="Name a folder that holds sequences.", file=path[:-2])
        out += [f"{reader}:{p}" for p in folders]
    return out
