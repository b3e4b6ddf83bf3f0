"""What must be true after every dataset that a fault has hit."""

from __future__ import annotations

import time
from collections.abc import Callable

from storage.artifact_folders import TEMPORARY_PREFIX, TRASH_PREFIX
from storage.file_lease import LEASES_FOLDER
from storage.local import LocalStore
from storage.opening import open_store
from storage.store import Store


def read_payloads(uri: str) -> dict[str, str]:
    """``log/chunk/stage/key`` → digest of the files, of every artifact of a store."""
    return {
        f"{a.address.log}/{a.address.chunk}/{a.address.stage}/{a.address.key}": a.manifest.payload_digest
        for a in open_store(uri).artifacts()
    }


def count_identical(found: dict[str, str], wanted: dict[str, str]) -> int:
    """How many artifacts are those of the undisturbed run, key and bytes."""
    return sum(found.get(name) == digest for name, digest in wanted.items())


def find_damage(uri: str) -> list[str]:
    """Artifacts whose bytes are not those of their manifest."""
    return [f"{name}: {error}" for name, error in open_store(uri).verify_all() if error is not None]


def list_leases(store: Store) -> list[str]:
    """Leases that are left; a killed process's file goes when another one has computed the stage."""
    if not isinstance(store, LocalStore):
        raise TypeError(f"no list of leases of {store.uri}")
    folder = store.root / LEASES_FOLDER
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def list_temporaries(store: Store) -> list[str]:
    """What is left of half-written artifacts after ``clean_temporaries``."""
    store.clean_temporaries()
    if not isinstance(store, LocalStore):
        raise TypeError(f"no list of temporaries of {store.uri}")
    prefixes = (TEMPORARY_PREFIX, TRASH_PREFIX)
    return sorted(str(path) for path in store.root.rglob(".*") if path.name.startswith(prefixes))


def wait_for_zero(count: Callable[[], int], seconds: float) -> int:
    """Counts until nothing is left or the time is over; what is left."""
    deadline = time.monotonic() + seconds
    while True:
        left = count()
        if left == 0 or time.monotonic() > deadline:
            return left
        time.sleep(1.0)
