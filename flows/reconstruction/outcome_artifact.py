"""How a child run hands its outcome to the dataset's flow: a table of one row among Prefect's artifacts.

A record in the store is found by its run's name alone, and an error leaves none; the state's message has no remedy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from prefect.artifacts import create_table_artifact

from flows.reconstruction.left_out import ChunksLeftOutError, describe_log, may_pass
from genre_tasks.errors import GenreError

DATASET_VARIABLE = "GENRE_DATASET"
"""The environment variable that names the dataset of a child run."""
OUTCOME_KEY = "outcome"
"""Key of the artifact."""


def is_child_run() -> bool:
    """Says whether this process runs a log for a dataset's flow.

    Returns:
        Whether the variable ``GENRE_DATASET`` is set, as the dataset's flow sets it for its child runs.
    """
    return bool(os.environ.get(DATASET_VARIABLE))


def publish_outcome(log: str, record: Mapping[str, Any] | None, error: Exception | None) -> None:
    """Writes how the run of a log ended, if it is a child run.

    Args:
        log: the log's URI.
        record: the record of its run; ``None`` where there is none.
        error: what is wrong, if anything is.
    """
    if not is_child_run():
        return
    row = describe_log(log, record, error) | {"is_passing": error is not None and not _is_final(error)}
    create_table_artifact(table=[row], key=OUTCOME_KEY, description="read by the dataset's flow")


def _is_final(error: Exception) -> bool:
    """Whether another try would end in the same error."""
    if isinstance(error, ChunksLeftOutError):
        return not error.is_passing
    return isinstance(error, GenreError) and not may_pass(error)
