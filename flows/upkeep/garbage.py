"""What of a store no run and no pin refers to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from flows.exchange.stored_scenes import IMPORTED
from flows.reconstruction.run_records import list_runs
from flows.upkeep.pins import list_pins, list_run_keys
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
        InputError: a record or a pin is damaged. Nothing may go then, as it might refer to anything.
        TransientIOError: the store does not answer.
    """
    artifacts = list(store.artifacts())
    wanted = [key for record in list_runs(store.uri) for key in list_run_keys(record)]
    wanted += [key for pin in list_pins(store) for key in pin.keys]
    kept = add_ancestors(wanted, {artifact.address.key: artifact for artifact in artifacts})
    # Scenes that somebody imported are asked for by their name, and no run made them.
    unused = [a for a in artifacts if a.address.key not in kept and a.address.dataset != IMPORTED]
    moment = now or datetime.now(UTC)
    old = [artifact for artifact in unused if _age_s(artifact, moment) >= min_age_s]
    return Garbage(tuple(old), len(artifacts) - len(unused), len(unused) - len(old))


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
