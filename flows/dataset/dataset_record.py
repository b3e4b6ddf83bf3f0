"""The name of a dataset and its record in the store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.dataset.dataset_summary import summarise_dataset
from flows.dataset.report.writing import write_dataset_report
from flows.observability.redaction import redact
from genre_tasks.atomic_path import atomic_path
from storage.io_errors import as_genre_error
from storage.opening import open_store

DATASETS = "datasets"
"""Name of the folder of all datasets' records."""


def name_dataset(logs: Sequence[str], preset: str, store: str, settings: Sequence[str] | None) -> str:
    """Names what a dataset's flow is asked for; the same request has the same name.

    Args:
        logs: URIs of logs, without stars.
        preset: name of the preset.
        store: folder (or URI) of the store; another store is another dataset, whose runs are not those of this one.
        settings: ``section.key=value`` strings over the preset.

    Returns:
        Twelve hex digits.

    >>> name_dataset(["kitti:a"], "demo", "store", None) == name_dataset(["kitti:a"], "demo", "store", [])
    True
    """
    text = json.dumps([list(logs), preset, store, list(settings or ())])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def write_dataset_record(store: str, name: str, preset: str, outcomes: Sequence[Mapping[str, Any]]) -> Path:
    """Writes how every log of a dataset ended: ``dataset.json`` for programs, ``report.html`` for people.

    Args:
        store: folder (or URI) of the store.
        name: the dataset's name.
        preset: name of the preset.
        outcomes: rows of the table of all logs.

    Returns:
        The report, on this machine.

    Raises:
        InputError: the store cannot be written.
        TransientIOError: the store does not answer.
    """
    records = open_store(store).records
    record_name = f"{DATASETS}/{name}"
    folder = records.pull(record_name)
    summary = summarise_dataset(store, preset, outcomes)
    rows = [{key: redact(value) if isinstance(value, str) else value for key, value in row.items()} for row in outcomes]
    record = {"dataset": name, "preset": preset, "logs": rows, "summary": summary.as_values()}
    path = folder / "dataset.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as part:
            part.write_text(json.dumps(record, indent=1), encoding="utf-8")
        report = write_dataset_report(folder / "report.html", summary)
    except OSError as error:
        raise as_genre_error(error, path) from error
    records.push(record_name)
    return report
