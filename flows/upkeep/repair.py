"""Damaged artifacts of a store: removed, and computed again by the runs that they are of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from flows.pipeline.damaged_artifacts import discard_if_damaged
from flows.reconstruction.record_files import read_sound_records, summarise_damage
from flows.upkeep.pins import list_run_keys
from genre_tasks.errors import ArtifactCorruptError, GenreError
from storage.address import Address
from storage.manifest import NewerSchemaError
from storage.store import Store


@dataclass(frozen=True)
class Repair:
    """What became of a damaged artifact.

    Attributes:
        name: its path in the store.
        problem: what was wrong with it.
        outcome: ``repaired``, ``removed`` or ``left``.
        why: the reason, where it was not repaired.
    """

    name: str
    problem: str
    outcome: str
    why: str = ""


def repair_artifacts(
    store: Store,
    damaged: Mapping[str, GenreError],
    run_again: Callable[[Mapping[str, Any]], None],
) -> Iterator[Repair]:
    """Removes damaged artifacts, and has the runs that they are of computed again.

    Args:
        store: that has them.
        damaged: by path, as :meth:`storage.store.Store.verify_all` names them.
        run_again: computes what the store lacks of a run; called with the run's record.

    Yields:
        What became of each artifact.

    Raises:
        InputError: a run's record is damaged, which is said when all else is done, or the store cannot be written.
    """
    records, damaged_records = read_sound_records(store.records.find("runs", "run.json"))
    addresses: dict[str, Address] = {}
    for name, error in damaged.items():
        try:
            # What cannot be read now may be whole: a mount that is away must not cost an artifact.
            if isinstance(error, NewerSchemaError) or not isinstance(error, ArtifactCorruptError):
                raise error
            address = Address.parse(name)
            discard_if_damaged(store, address)
        except GenreError as reason:
            yield Repair(name, error.problem, "left", f"{reason.problem}. {reason.remedy}")
        else:
            addresses[name] = address
    failures: dict[str, str] = {}
    for record in records:
        keys = set(list_run_keys(record))
        wanted = [name for name, address in addresses.items() if address.key in keys]
        missing = [name for name in wanted if _is_missing(store, addresses[name])]
        # An edited run is made from another one by its edits, not from a log.
        if not missing or "edited" in record:
            continue
        try:
            run_again(record)
        except GenreError as error:
            failures |= {name: str(error) for name in missing}
    for name, address in addresses.items():
        why_missing = failures.get(name, _explain(address, records, bool(damaged_records)))
        yield _find_outcome(store, name, address, damaged[name].problem, why_missing)
    # At the end: one damaged record must not keep the runs of the others from being mended.
    if damaged_records:
        raise summarise_damage(damaged_records)


def _is_missing(store: Store, address: Address) -> bool:
    try:
        return store.find(address) is None
    except GenreError:
        # It is there, and what is wrong with it is said with its outcome.
        return False


def _find_outcome(store: Store, name: str, address: Address, problem: str, why_missing: str) -> Repair:
    try:
        artifact = store.find(address)
        if artifact is None:
            return Repair(name, problem, "removed", why_missing)
        # What runs trust may be what was damaged in the first place.
        store.verify(artifact, reads_all=True)
    except GenreError as reason:
        return Repair(name, problem, "left", f"{reason.problem}. {reason.remedy}")
    return Repair(name, problem, "repaired")


def _explain(address: Address, records: list[dict[str, Any]], some_unread: bool) -> str:
    found = [record for record in records if address.key in list_run_keys(record)]
    if not found:
        return "no run whose record can be read refers to it" if some_unread else "no run refers to it"
    if all("edited" in record for record in found):
        return f"`genre edit` makes it again for run {found[0]['run']}"
    return "the code, the weights or the log have changed since: run the log again"
