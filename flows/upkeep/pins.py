"""Pins: runs and artifacts that stay in a store although no record of a run refers to them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from flows.reconstruction.named_results import NamedRun, find_named
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError
from storage.io_errors import as_genre_error
from storage.store import Store

PINS = "pins"
"""Name of the folder of all pins."""
_FILE = "pin.json"
_NAME_LENGTH = 12


@dataclass(frozen=True)
class Pin:
    """What stays.

    Attributes:
        name: of a run, or the first twelve digits of an artifact's key.
        keys: of the artifacts that stay, with all that they were made from.
        note: why, in the user's words.
        pinned_at: when, ISO 8601.
    """

    name: str
    keys: tuple[str, ...]
    note: str = ""
    pinned_at: str = ""


def add_pin(store: Store, name: str, note: str = "") -> Pin:
    """Pins a run or an artifact.

    Args:
        store: that has it.
        name: of the run or key, or the first characters.
        note: why.

    Returns:
        The pin.

    Raises:
        InputError: none or several begin so, or the store cannot be written.
    """
    found = find_named(store, name)
    if isinstance(found, NamedRun):
        keys = tuple(list_run_keys(found.record))
        pin_name = str(found.record["run"])
    else:
        keys = (found.manifest.key,)
        pin_name = found.manifest.key[:_NAME_LENGTH]
    pin = Pin(pin_name, keys, note, datetime.now(UTC).isoformat(timespec="seconds"))
    record_name = f"{PINS}/{pin_name}"
    folder = store.records.pull(record_name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(folder / _FILE) as part:
            part.write_text(json.dumps(asdict(pin), indent=1), encoding="utf-8")
    except OSError as error:
        raise as_genre_error(error, folder) from error
    store.records.push(record_name)
    return pin


def remove_pin(store: Store, name: str) -> Pin:
    """Takes a pin away. What it kept stays until `genre gc` removes it.

    Args:
        store: that has it.
        name: of the pin, or the first characters.

    Returns:
        The pin that was removed.

    Raises:
        InputError: no pin, or several, begin so.
    """
    found = [pin for pin in list_pins(store) if pin.name.startswith(name) and name]
    if len(found) != 1:
        raise InputError(
            f"{len(found)} pins begin with '{name}'", remedy="`genre pin --list` lists them.", file=store.uri
        )
    store.records.remove(f"{PINS}/{found[0].name}")
    return found[0]


def list_pins(store: Store) -> list[Pin]:
    """Reads all pins of a store.

    Args:
        store: to look in.

    Returns:
        The pins, oldest first.

    Raises:
        InputError: one is damaged.
    """
    # To ignore a damaged one would let what it keeps be removed.
    return [_read_pin(path) for path in store.records.find(PINS, _FILE)]


def read_sound_pins(store: Store) -> tuple[list[Pin], dict[str, InputError]]:
    """Reads all pins of a store, and goes on where one is damaged.

    Args:
        store: to look in.

    Returns:
        The sound pins, oldest first, and the errors of the damaged ones by name of the folder.
    """
    pins = []
    damaged = {}
    for path in store.records.find(PINS, _FILE):
        try:
            pins.append(_read_pin(path))
        except InputError as error:
            damaged[path.parent.name] = error
    return pins, damaged


def _read_pin(path: Path) -> Pin:
    try:
        values = json.loads(path.read_bytes())
        keys = tuple(str(key) for key in values["keys"])
        return Pin(str(values["name"]), keys, str(values["note"]), str(values["pinned_at"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("the pin is damaged", remedy="Remove the folder, and pin again.", file=path) from error


def list_run_keys(record: dict[str, object]) -> list[str]:
    """Lists the keys of all artifacts of a run.

    Args:
        record: as ``run.json`` holds it.

    Returns:
        The keys.
    """
    chunks: list[dict[str, list[dict[str, str]]]] = record["chunks"]  # type: ignore[assignment]
    return [stage["key"] for chunk in chunks for stage in chunk["stages"]]
