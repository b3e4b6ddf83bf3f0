"""What one child run is about: a log, or a chunk of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from flows.pipeline.log_cache import select_chunks
from flows.pipeline.progress import get_reporter
from genre_tasks.config import PipelineConfig

Unit = Literal["log", "chunk"]


class WorkUnit(NamedTuple):
    """What one child run is about.

    Attributes:
        log: the log's URI.
        chunk: number of the chunk; ``None`` for all chunks of the log.
    """

    log: str
    chunk: int | None = None

    def tags(self) -> list[str]:
        """Writes the unit as tags of a flow run.

        >>> WorkUnit("pandaset:data/002", 1).tags()
        ['genre-log:pandaset:data/002', 'genre-chunk:1']
        """
        chunk = [] if self.chunk is None else [f"genre-chunk:{self.chunk}"]
        return [f"genre-log:{self.log}", *chunk]


def read_unit(tags: Sequence[str]) -> WorkUnit | None:
    """Reads the unit of a flow run from its tags.

    Args:
        tags: of the flow run, in any order.

    Returns:
        The unit; ``None`` for a run of something else.

    >>> read_unit(["genre-chunk:1", "other", "genre-log:pandaset:data/002"])
    WorkUnit(log='pandaset:data/002', chunk=1)
    """
    values = dict(tag.split(":", 1) for tag in tags if tag.startswith(("genre-log:", "genre-chunk:")))
    if "genre-log" not in values:
        return None
    chunk = values.get("genre-chunk")
    return WorkUnit(values["genre-log"], None if chunk is None else int(chunk))


def list_units(logs: Sequence[str], unit: Unit, config: PipelineConfig) -> list[WorkUnit]:
    """Lists what the child runs of a dataset are about.

    Args:
        logs: URIs of logs, without stars.
        unit: ``log`` for one run a log, ``chunk`` for one run a chunk.
        config: its section ``ingest`` says how long a chunk is.

    Returns:
        The units in the order of the logs, without doubles. A log that cannot be opened is one unit: its run says why.
    """
    from genre_tasks.errors import GenreError

    if unit == "log":
        return [WorkUnit(log) for log in dict.fromkeys(logs)]
    units: list[WorkUnit] = []
    for log in dict.fromkeys(logs):
        try:
            units += [WorkUnit(log, chunk) for chunk in select_chunks(log, config, None)]
        except GenreError as error:
            # Perhaps only the workers have the logs. Who asked for chunks is to know that they are not shared out.
            get_reporter().message(
                f"warning: {log} is one run for all chunks, as it cannot be opened here: {error.problem}"
            )
            units.append(WorkUnit(log))
    return units
