"""The name of a dataset and its record in the store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from genre_tasks.atomic_path import atomic_path
from storage.local import open_store

_FOLDER = "datasets"


def name_dataset(logs: Sequence[str], preset: str, settings: Sequence[str] | None) -> str:
    """Names what a dataset's flow is asked for; the same request has the same name.

    Args:
        logs: URIs of logs, without stars.
        preset: name of the preset.
        settings: ``section.key=value`` strings over the preset.

    Returns:
        Twelve hex digits.

    >>> name_dataset(["synthetic:street?seed=1"], "demo", None) == name_dataset(["synthetic:street?seed=1"], "demo", [])
    True
    """
    text = json.dumps([list(logs), preset, list(settings or ())])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def dataset_folder(store: str, name: str) -> Path:
    """Finds the folder of a dataset's record and report.

    Args:
        store: folder (or URI) of the store.
        name: the dataset's name.

    Returns:
        The folder, which may not exist yet.
    """
    return open_store(store).root / _FOLDER / name


def write_dataset_record(store: str, name: str, preset: str, outcomes: Sequence[Mapping[str, Any]]) -> Path:
    """Writes how every log of a dataset ended as ``dataset.json``.

    Args:
        store: folder (or URI) of the store.
        name: the dataset's name.
        preset: name of the preset.
        outcomes: rows of the table of all logs.

    Returns:
        The file.

    Raises:
        OSError: the folder cannot be written.
    """
    folder = dataset_folder(store, name)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "dataset.json"
    record = {"dataset": name, "preset": preset, "store": store, "logs": [dict(row) for row in outcomes]}
    with atomic_path(path) as part:
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
    return path
