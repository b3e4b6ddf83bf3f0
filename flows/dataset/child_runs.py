"""Child runs as the supervisor knows them; one class implements them by Prefect's API, tests by a fake."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from flows.dataset.work_units import WorkUnit

DATASET_TAG = "genre-dataset:"
"""How the tag begins that all flow runs of one dataset have, its parents among them."""
SILENT = "SILENT"
"""The server missed heartbeats of a run and calls it Crashed; by its heartbeats it may live nevertheless."""
ACTIVE_STATES = frozenset({"SCHEDULED", "PENDING", "RUNNING", "PAUSED", "CANCELLING", SILENT})
"""Types of states in which a run may still do something."""
# One that is being cancelled sends until its worker has stopped it.
SENDING_STATES = frozenset({"RUNNING", "CANCELLING", SILENT})
"""Types of states in which a living run sends heartbeats."""


@dataclass(frozen=True)
class ChildRun:
    """A child run as the server last reported it.

    Attributes:
        id: the flow run's id.
        unit: what it is about.
        state: type of its state, as Prefect names it, such as ``RUNNING``; or :data:`SILENT`.
        message: of its state.
        where: host and process, once a worker has started it.
        seconds: how long it has been running.
        is_ours: whether this parent submitted it, and not an earlier one of the same dataset.
    """

    id: str
    unit: WorkUnit
    state: str
    message: str = ""
    where: str = ""
    seconds: float = 0.0
    is_ours: bool = True


class ChildRuns(Protocol):
    """The child runs of one dataset on a Prefect server."""

    def find(self) -> list[ChildRun]:
        """Finds runs of an earlier life of this parent, and active ones of any parent of the same dataset.

        Returns:
            The runs, oldest first.
        """
        ...

    def submit(self, requests: Sequence[tuple[WorkUnit, int]]) -> Sequence[ChildRun]:
        """Submits runs, several at a time; the same unit and attempt give the same run.

        Args:
            requests: what each run is about, and how often the unit has been submitted before.

        Returns:
            The runs, in the order of the requests.
        """
        ...

    def read(self, ids: Sequence[str]) -> Mapping[str, ChildRun]:
        """Reads the state of runs.

        Args:
            ids: of the runs.

        Returns:
            The runs by id; one that was deleted is missing.
        """
        ...

    def read_heartbeats(self, ids: Sequence[str]) -> Mapping[str, str]:
        """Reads when runs have last shown that they are alive.

        Args:
            ids: of the runs.

        Returns:
            By id, a text that changes with every heartbeat; nothing for a run without any.
        """
        ...

    def read_event_delay(self) -> float:
        """Measures how far the server is behind with the events that it has received, heartbeats among them.

        Returns:
            Seconds since the newest event that can be read, by the server's clock. The parent itself sends a heartbeat
            every thirty seconds, so that a server that keeps up is less than that behind.
        """
        ...

    def read_stages(self, ids: Sequence[str]) -> Mapping[str, str]:
        """Reads which stage runs are in.

        Args:
            ids: of the runs.

        Returns:
            By id, the name of the stage's task run.
        """
        ...

    def crash(self, run: ChildRun, reason: str) -> None:
        """Sets a run to Crashed, so that its slots are free; a run that has ended meanwhile is left as it is.

        Args:
            run: the run.
            reason: message of the state.
        """
        ...

    def read_outcomes(self, ids: Sequence[str]) -> Mapping[str, dict[str, Any]]:
        """Reads how runs ended, as the runs themselves have left it.

        Args:
            ids: of the runs.

        Returns:
            By id, what :func:`flows.reconstruction.outcome_artifact.publish_outcome` wrote; nothing for a run that
            wrote nothing.
        """
        ...
