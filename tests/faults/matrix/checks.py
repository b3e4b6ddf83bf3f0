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
    """Leases that are left; a killed process's lease goes when another one has computed the stage."""
    if not isinstance(store, LocalStore):
        return [name for name in list_objects(store) if name.startswith(f"{LEASES_FOLDER}/")]
    folder = store.root / LEASES_FOLDER
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def list_temporaries(store: Store) -> list[str]:
    """What is left of half-written artifacts after ``clean_temporaries``."""
    if isinstance(store, LocalStore):
        store.clean_temporaries()
        prefixes = (TEMPORARY_PREFIX, TRASH_PREFIX)
        return sorted(str(path) for path in store.root.rglob(".*") if path.name.startswith(prefixes))
    # Of an object, nobody can say whether its writer lives: its age decides, and here all writers have ended.
    store.clean_temporaries(older_than_s=0.0)
    folders = tuple(f"{artifact.address}/" for artifact in store.artifacts())
    records = ("runs/", "datasets/", f"{LEASES_FOLDER}/")
    return [name for name in list_objects(store) if not name.startswith((*folders, *records))]


def list_objects(store: Store) -> list[str]:
    """Names of all objects of a store in a bucket."""
    from storage.objects.bucket import Bucket

    return sorted(info.name for info in Bucket(store.uri).list())


def wait_for_zero(count: Callable[[], int], seconds: float) -> int:
    """Counts until nothing is left or the time is over; what is left."""
    deadline = time.monotonic() + seconds
    while True:
        left = count()
        if left == 0 or time.monotonic() > deadline:
            return left
        time.sleep(1.0)
