"""The table of all logs in Prefect's UI while a dataset runs, and how much of it is done."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any, cast
from uuid import UUID

from prefect.artifacts import create_progress_artifact, create_table_artifact, update_progress_artifact
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import ArtifactUpdate

TABLE_KEY = "logs"
"""Key of the table."""
PROGRESS_KEY = "dataset-progress"
"""Key of the progress."""
FINAL_STATUSES = frozenset({"done", "partly_done", "failed"})
"""Statuses of a row that does not change any more."""
_log = logging.getLogger("genre")
Row = Mapping[str, Any]


def describe_progress(rows: Sequence[Row]) -> str:
    """Says in a line how far a dataset is.

    Args:
        rows: of the table.

    Returns:
        A line.

    >>> describe_progress([{"status": "done"}, {"status": "failed"}, {"status": "running"}])
    '1 of 3 done, 1 failed, 1 running'
    """
    counts = {"done": 0} | {row["status"]: 0 for row in rows}
    for row in rows:
        counts[row["status"]] += 1
    others = [f"{count} {status.replace('_', ' ')}" for status, count in sorted(counts.items()) if status != "done"]
    return ", ".join([f"{counts['done']} of {len(rows)} done", *others])


class LiveTable:
    """Publishes rows as a table and a progress artifact; an unchanged table, or one too soon, is not sent.

    Args:
        every_s: seconds between two tables, at least.
    """

    def __init__(self, every_s: float = 5.0) -> None:
        self._every_s = every_s
        self._last_s = float("-inf")
        self._last_rows: list[dict[str, Any]] = []
        self._table: UUID | None = None
        self._progress: UUID | None = None

    def show(self, rows: Sequence[Row]) -> None:
        """Publishes rows if they have changed and the last table is old enough; an error is logged, not raised.

        Args:
            rows: of the table.
        """
        if time.monotonic() - self._last_s < self._every_s or self._last_rows == list(rows):
            return
        # A table that is late is no reason to end a dataset that runs for days.
        try:
            self.show_now(rows)
        except Exception as error:
            _log.warning("the table of logs could not be sent: %s", error)

    def show_now(self, rows: Sequence[Row]) -> None:
        """Publishes rows.

        Args:
            rows: of the table.

        Raises:
            Exception: as Prefect's client raises it.
        """
        self._last_s = time.monotonic()
        self._last_rows = [dict(row) for row in rows]
        description = describe_progress(rows)
        ended = sum(row["status"] in FINAL_STATUSES for row in rows)
        percent = 100.0 * ended / max(len(rows), 1)
        if self._table is None:
            created = create_table_artifact(table=self._last_rows, key=TABLE_KEY, description=description)
            # Prefect's types allow for a caller in an event loop, which this is not.
            self._table = cast(UUID, created)
        else:
            # Updated in place: a new version every few seconds would fill the server's database.
            update = ArtifactUpdate(data=json.dumps(self._last_rows), description=description)
            with get_client(sync_client=True) as client:
                client.update_artifact(self._table, update)
        if self._progress is None:
            created = create_progress_artifact(percent, key=PROGRESS_KEY, description=description)
            self._progress = cast(UUID, created)
        else:
            update_progress_artifact(self._progress, percent, description=description)
