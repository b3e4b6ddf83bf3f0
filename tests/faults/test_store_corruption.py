"""Every file of every kind, truncated or with one bit flipped: found, named, never half-read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.errors import ArtifactCorruptError
from storage.local import LocalStore
from storage.manifest import MANIFEST
from tests.contracts.store_suite import address
from tests.storage.artifact_values import COLORS, MAKERS, assert_same, make


def truncated(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data)))]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    out[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def swollen(data: bytes, rng: np.random.Generator) -> bytes:
    return data + rng.bytes(1)


@pytest.mark.parametrize("damage", [truncated, flipped, swollen])
@pytest.mark.parametrize("kind", MAKERS)
def test_damage_is_found_and_named(kind: str, damage, tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), kind, make(kind))
    rng = np.random.default_rng(0)
    for entry in artifact.manifest.files:
        path = artifact.path / entry.path
        good = path.read_bytes()
        for _ in range(5):
            path.write_bytes(damage(good, rng))
            with pytest.raises(ArtifactCorruptError, match=r"bytes, expected|sha256") as caught:
                store.read(artifact)
            assert caught.value.file == str(path) and caught.value.chunk == 0
        path.write_bytes(good)
    store.read(artifact)


@pytest.mark.parametrize("kind", MAKERS)
def test_damage_of_a_manifest_is_found(kind: str, tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), kind, make(kind))
    path = artifact.path / MANIFEST
    good, rng = path.read_bytes(), np.random.default_rng(0)
    for k in range(30):
        path.write_bytes((truncated, flipped)[k % 2](good, rng))
        try:
            found = store.find(address())
            assert found is not None and found.manifest == artifact.manifest  # white space, or the case of an escape
        except ArtifactCorruptError as error:
            assert error.file == str(path)


@pytest.mark.parametrize("kind", MAKERS)
def test_a_corrupt_artifact_is_replaced_by_the_next_commit(kind: str, tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), kind, make(kind))
    victim = artifact.path / artifact.manifest.files[-1].path
    victim.write_bytes(victim.read_bytes()[:-1])
    again = store.commit(address(), kind, make(kind))
    assert again.manifest.payload_digest == artifact.manifest.payload_digest
    assert_same(make(kind), store.read(again), kind, COLORS)
    assert [p.name for p in artifact.path.parent.iterdir()] == [artifact.path.name]
