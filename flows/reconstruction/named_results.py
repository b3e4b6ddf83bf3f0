"""Runs and artifacts by the first characters of their name or key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flows.reconstruction.run_records import list_runs
from genre_tasks.errors import InputError

if TYPE_CHECKING:
    from storage.store import Artifact, Store


@dataclass(frozen=True)
class NamedRun:
    """A finished run.

    Attributes:
        record: as ``run.json`` holds it.
    """

    record: dict[str, Any]


def find_named(store: Store, name: str) -> NamedRun | Artifact:
    """Finds the one run or artifact whose name or key begins so.

    Args:
        store: to look in.
        name: the first characters; a run's name and an artifact's key are both hex digits.

    Returns:
        The run, or the artifact.

    Raises:
        InputError: none begins so, or several do.
    """
    # An empty text, which an unset variable of a script's leaves, would fit to everything.
    runs = list_runs(store.uri, name) if name else []
    # Runs are fewer and asked for more often.
    if len(runs) == 1:
        return NamedRun(runs[0])
    artifacts = list(store.artifacts(key_start=name)) if name else []
    # Several may share the first digits; to guess which one is meant would show the wrong one.
    if runs or len(artifacts) != 1:
        raise InputError(
            f"{len(runs) + len(artifacts)} runs or artifacts begin with '{name}'",
            remedy="`genre show runs` and `genre show stages` list them; give more of the name.",
            file=store.uri,
        )
    return artifacts[0]
