"""What of a store no run and no pin refers to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from flows.exchange.imported_scenes import IMPORTED
from flows.reconstruction.run_records import list_runs
from flows.simulation.recorded_settings import read_recorded_edits
from flows.upkeep.pins import Pin, list_pins, list_run_keys
from genre_tasks.errors import InputError
from genre_tasks.scene_edits.edits import Insert
from storage.store import Artifact, Store

MIN_AGE_S = 86_400.0
"""What was made so recently stays: a run that goes on has no record yet."""


@dataclass(frozen=True)
class Garbage:
    """What may go.

    Attributes:
        artifacts: that nothing refers to, in the order of their paths.
        kept: how many are referred to, or were imported.
        young: how many nothing refers to that were made too recently.
    """

    artifacts: tuple[Artifact, ...]
    kept: int
    young: int


def find_garbage(store: Store, min_age_s: float = MIN_AGE_S, now: datetime | None = None) -> Garbage:
    """Finds the artifacts that no record of a run and no pin refers to, directly or as what something was made from.

    Args:
        store: to look in.
        min_age_s: seconds since an artifact was made, at least.
        now: the time that ages are counted to; ``None`` for the present.

    Returns:
        What may go, and how much stays.

    Raises:
        InputError: a record, a pin or a pinned artifact is damaged, or the record of a run is gone that an edited one
            is made from. Nothing may go then, as it might refer to anything.
        TransientIOError: the store does not answer.
    """
    artifacts = list(store.artifacts())
    by_key = {artifact.address.key: artifact for artifact in artifacts}
    records = list_runs(store.uri)
    pins = list_pins(store)
    _require_sources(store, records)
    _require_pinned(store, pins, by_key)
    wanted = [key for record in records for key in list_run_keys(record)]
    wanted += [key for pin in pins for key in pin.keys]
    kept = add_ancestors(wanted, by_key)
    # Scenes that somebody imported are asked for by their name, and no run made them.
    unused = [a for a in artifacts if a.address.key not in kept and a.address.dataset != IMPORTED]
    moment = now or datetime.now(UTC)
    old = [artifact for artifact in unused if _age_s(artifact, moment) >= min_age_s]
    return Garbage(tuple(old), len(artifacts) - len(unused), len(unused) - len(old))


def _require_sources(store: Store, records: Sequence[Mapping[str, Any]]) -> None:
    """Raises where an edited run could not be opened any more, and what it needs would be taken for garbage."""
    names = [str(record["run"]) for record in records]
    for record in records:
        for source in list_sources(record):
            if not any(name.startswith(source) for name in names):
                problem = f"run {record['run']} is edited from run {source}, whose record is gone"
                remedy = f"Put runs/{source} back, or remove runs/{record['run']} too."
                raise InputError(problem, remedy=remedy, file=store.uri)


def _require_pinned(store: Store, pins: Sequence[Pin], by_key: Mapping[str, Artifact]) -> None:
    """Raises where a pinned artifact cannot be read, since what it was made from is then unknown."""
    for pin in pins:
        if any(key not in by_key for key in pin.keys):
            problem = f"what {pin.name} pins is damaged or gone"
            remedy = f"Run `genre verify --repair`, or `genre unpin {pin.name}`."
            raise InputError(problem, remedy=remedy, file=store.uri)


def list_sources(record: Mapping[str, Any]) -> list[str]:
    """Lists the runs that an edited run is made from: the recorded one, and those that inserted actors come from.

    Args:
        record: as ``run.json`` holds it.

    Returns:
        Names, or how they begin; none if the run is not edited.

    Raises:
        InputError: another version wrote the record, with edits that this one does not know.
    """
    edited = record.get("edited")
    if edited is None:
        return []
    edits = read_recorded_edits(record).edits
    givers = {edit.from_run for edit in edits if isinstance(edit, Insert) and edit.from_run is not None}
    return [str(edited["run"]), *sorted(givers)]


def add_ancestors(keys: Iterable[str], by_key: Mapping[str, Artifact]) -> set[str]:
    """Adds the keys of everything that artifacts were made from.

    Args:
        keys: of the artifacts.
        by_key: all artifacts of the store.

    Returns:
        The keys and those of all ancestors that the store has.
    """
    found: set[str] = set()
    todo = list(keys)
    while todo:
        key = todo.pop()
        if key in found:
            continue
        found.add(key)
        if key in by_key:
            todo += by_key[key].manifest.inputs.values()
    return found


def measure_bytes(artifacts: Iterable[Artifact]) -> int:
    """Adds up the sizes of the files of artifacts.

    Args:
        artifacts: any.

    Returns:
        Bytes.
    """
    return sum(entry.size for artifact in artifacts for entry in artifact.manifest.files)


def _age_s(artifact: Artifact, now: datetime) -> float:
    try:
        made_at = datetime.fromisoformat(artifact.manifest.created_at)
    except ValueError:
        # Without a time it may be of this moment.
        return 0.0
    return (now - (made_at if made_at.tzinfo else made_at.replace(tzinfo=UTC))).total_seconds()
