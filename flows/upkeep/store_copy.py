"""Copies of a store, or of some of its runs, to another one: the same bytes, and resumed where a copy was stopped."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.dataset.dataset_record import DATASETS
from flows.reconstruction.record_files import read_record, read_sound_records, summarise_damage
from flows.reconstruction.run_records import find_run_record, name_run_folder
from flows.upkeep.garbage import add_ancestors, list_sources, measure_bytes
from flows.upkeep.pins import PINS, list_run_keys, read_sound_pins
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import ArtifactCorruptError, InputError
from storage.io_errors import as_genre_error
from storage.store import Artifact, Store

_RUN_RECORD = "run.json"
_RECORDS = (("runs", _RUN_RECORD), (DATASETS, "dataset.json"), (PINS, "pin.json"))


@dataclass(frozen=True)
class CopyResult:
    """What a copy did.

    Attributes:
        copied: artifacts that the target did not have.
        skipped: artifacts that it had.
        bytes_copied: of the copied artifacts' files.
        records: folders of records of which the target lacked something.
    """

    copied: int
    skipped: int
    bytes_copied: int
    records: int


def copy_store(
    source: Store,
    target: Store,
    runs: Sequence[str] = (),
    pinned: bool = False,
    report: Callable[[int, int, int], None] = lambda done, total, bytes_copied: None,
) -> CopyResult:
    """Copies artifacts with all that they were made from, and the records of runs, datasets and pins.

    Args:
        source: to copy from; nothing in it is changed.
        target: to copy to; what it has stays, be it artifacts or files of records.
        runs: names of runs, or their first characters: only these are copied, and not the rest of the store.
        pinned: whether only pinned runs and artifacts are copied, beside those of ``runs``.
        report: called with how many artifacts are done, how many there are, and the bytes copied.

    Returns:
        What was done.

    Raises:
        InputError: no run, or several, begin so; the target cannot be written; or an artifact of a run or a pin is gone
            or has a damaged manifest, or a record is damaged, which is said when all else is copied.
        ArtifactCorruptError: artifacts of the source or the target are damaged, which is said when all else is copied.
        TransientIOError: a store does not answer.
    """
    selection = _select_named(source, runs, pinned) if runs or pinned else _select_all(source)
    artifacts = selection.artifacts
    copied, damaged = _copy_artifacts(source, target, artifacts, report)
    # After the artifacts: a record must not refer to what is not there yet.
    copied_records = [name for name in selection.records if _copy_record(source, target, name)]
    # Once more, since `genre gc` removes what no record refers to, and the records have come only now.
    sound = [artifact for artifact in artifacts if artifact.address.key not in damaged]
    added, damaged_since = _copy_artifacts(source, target, sound, lambda done, total, bytes_copied: None)
    copied |= added
    damaged |= damaged_since
    # All that is sound is copied first: whoever moves away from a failing disk needs that most.
    _require_complete(source, selection, damaged)
    return CopyResult(len(copied), len(artifacts) - len(copied), measure_bytes(copied.values()), len(copied_records))


@dataclass(frozen=True)
class _Selection:
    # What of the source is asked for: artifacts and folders of records that it has, keys that it lacks, and the errors
    # of records that are left out.
    artifacts: Sequence[Artifact]
    records: Sequence[str]
    missing: Sequence[str]
    damaged_records: Mapping[str, InputError]


def _select_all(source: Store) -> _Selection:
    artifacts = list(source.artifacts())
    keys = {artifact.address.key for artifact in artifacts}
    names = _list_records(source)
    sound, damaged = read_sound_records(source.records.find("runs", _RUN_RECORD))
    wanted = {key for record in sound for key in list_run_keys(record)}
    pins, damaged_pins = read_sound_pins(source)
    wanted |= {key for pin in pins for key in pin.keys}
    left_out = {name_run_folder(name) for name in damaged} | {f"{PINS}/{name}" for name in damaged_pins}
    records = [name for name in names if name not in left_out]
    return _Selection(artifacts, records, sorted(wanted - keys), damaged | damaged_pins)


def _select_named(source: Store, runs: Sequence[str], pinned: bool) -> _Selection:
    artifacts = list(source.artifacts())
    by_key = {artifact.address.key: artifact for artifact in artifacts}
    pins, damaged_pins = read_sound_pins(source) if pinned else ([], {})
    pinned_runs = [pin.name for pin in pins if source.records.find("runs", _RUN_RECORD, pin.name)]
    found = _find_with_recorded([find_run_record(source.uri, run) for run in (*runs, *pinned_runs)], source)
    wanted = {key for record in found for key in list_run_keys(dict(record))}
    wanted |= {key for pin in pins for key in pin.keys}
    needed = add_ancestors(wanted, by_key)
    names = {name_run_folder(str(record["run"])) for record in found}
    names |= {f"{PINS}/{pin.name}" for pin in pins} | {name_run_folder(pin.name) for pin in pins}
    return _Selection(
        artifacts=[artifact for artifact in artifacts if artifact.address.key in needed],
        records=[name for name in _list_records(source) if name in names],
        missing=sorted(wanted - set(by_key)),
        damaged_records=damaged_pins,
    )


def _require_complete(source: Store, selection: _Selection, damaged: Mapping[str, ArtifactCorruptError]) -> None:
    """Raises where something that is asked for could not be copied."""
    remedy = "Run `genre verify --repair` there, and copy again."
    damaged_records = selection.damaged_records
    note = f"; so are {len(damaged_records)} records" if damaged_records else ""
    if damaged:
        first = next(iter(damaged.values()))
        problem = f"{len(damaged)} artifacts are damaged{note}, and all else is copied; the first: {first.problem}"
        raise ArtifactCorruptError(problem, remedy=remedy, file=first.file) from first
    if missing := selection.missing:
        problem = (
            f"{len(missing)} artifacts of runs or pins are damaged or gone, such as {missing[0][:12]}{note}; "
            "all else is copied"
        )
        raise InputError(problem, remedy=remedy, file=source.uri)
    if damaged_records:
        raise summarise_damage(damaged_records, "Then copy again.")


def _find_with_recorded(records: Iterable[Mapping[str, Any]], source: Store) -> list[Mapping[str, Any]]:
    """Adds the runs that edited ones are made from, and those that their inserted actors come from."""
    found: dict[str, Mapping[str, Any]] = {}
    waiting = list(records)
    while waiting:
        record = waiting.pop()
        if str(record["run"]) in found:
            continue
        found[str(record["run"])] = record
        waiting += [find_run_record(source.uri, name) for name in list_sources(record)]
    return list(found.values())


def _copy_artifacts(
    source: Store, target: Store, artifacts: Sequence[Artifact], report: Callable[[int, int, int], None]
) -> tuple[dict[str, Artifact], dict[str, ArtifactCorruptError]]:
    """Copies what the target lacks, and goes on where an artifact is damaged; both by key."""
    copied: dict[str, Artifact] = {}
    damaged: dict[str, ArtifactCorruptError] = {}
    for done, artifact in enumerate(artifacts):
        report(done, len(artifacts), measure_bytes(copied.values()))
        try:
            present = target.find(artifact.address)
            # Payloads may differ between machines; then the target's artifact is as right as the source's.
            if present is None:
                target.adopt(artifact.manifest, source.fetch(artifact))
                copied[artifact.address.key] = artifact
        except ArtifactCorruptError as error:
            damaged[artifact.address.key] = error
    report(len(artifacts), len(artifacts), measure_bytes(copied.values()))
    return copied, damaged


def _list_records(store: Store) -> list[str]:
    return [f"{parent}/{path.parent.name}" for parent, file in _RECORDS for path in store.records.find(parent, file)]


def _copy_record(source: Store, target: Store, name: str) -> bool:
    """Copies the files of a folder that the target lacks; whether there were any."""
    folder = source.records.pull(name)
    goal = target.records.pull(name)
    # A run's record comes last: a folder without it belongs to a run that did not end.
    files = sorted(_list_files(folder), key=lambda path: path == folder / _RUN_RECORD)
    is_changed = False
    try:
        for path in files:
            place = goal / path.relative_to(folder)
            # What the target has may be newer, such as the record of a run that was repeated there.
            if place.exists():
                continue
            is_changed = True
            place.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(place) as part:
                if path == folder / _RUN_RECORD:
                    # Where the record is now; all else is as it was.
                    values = read_record(path) | {"store": target.uri, "report": str(goal / "report.html")}
                    part.write_text(json.dumps(values, indent=1), encoding="utf-8")
                else:
                    shutil.copyfile(path, part)
    except OSError as error:
        raise as_genre_error(error, goal) from error
    # Even without a change: a copy that was stopped may have left files that are in no bucket yet.
    target.records.push(name)
    return is_changed


def _list_files(folder: Path) -> Iterable[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts):
            yield path
