"""Which chunks of which logs an experiment measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flows.pipeline.log_cache import expand_logs, select_chunks
from genre_tasks.config import PipelineConfig


@dataclass(frozen=True)
class LogChunk:
    """A chunk of a log.

    Attributes:
        log: the log's URI.
        chunk: index of the chunk, from 0.

    >>> str(LogChunk("synthetic:street?seed=1001", 0))
    'synthetic:street?seed=1001 chunk 0'
    """

    log: str
    chunk: int

    def __str__(self) -> str:
        return f"{self.log} chunk {self.chunk}"


def select_log_chunks(logs: Sequence[str], chunks: list[int] | None, config: PipelineConfig) -> list[LogChunk]:
    """Lists the chunks to measure, log by log.

    Args:
        logs: URIs; ``pandaset:PATH/*`` stands for every sequence in a folder.
        chunks: indices to take of each log; ``None`` takes all of them.
        config: its section ``ingest`` decides how long a chunk is.

    Returns:
        The chunks in the order of ``logs``, then of ``chunks``, each once.

    Raises:
        InputError: a log does not have one of the chunks, or no folder matches a URI.
    """
    # Log by log, because the cache keeps few opened logs.
    named = (LogChunk(log, chunk) for log in expand_logs(list(logs)) for chunk in select_chunks(log, config, chunks))
    # A log that a star and a name both name would count twice in every mean.
    return list(dict.fromkeys(named))
