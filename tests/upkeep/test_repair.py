"""Outcomes of repairs: each artifact has one, and it is true, whatever becomes of the others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from flows.upkeep.repair import Repair, repair_artifacts
from genre_tasks.errors import GenreError, InputError
from storage.address import Address
from storage.local import LocalStore
from storage.manifest import MANIFEST
from storage.store import Artifact
from tests.contracts.store_suite import KEY, OTHER, address
from tests.storage.artifact_values import make


@pytest.fixture
def store(tmp_path: Path) -> LocalStore:
    """A store with two artifacts that no run refers to."""
    store = LocalStore(tmp_path / "store")
    for key in (KEY, OTHER):
        store.commit(address(key=key), "evaluation", make("evaluation"))
    return store


def repair(store: LocalStore) -> list[Repair]:
    def run_again(record: Mapping[str, Any]) -> None:
        raise AssertionError("there is no run")

    damage: dict[str, GenreError] = {name: error for name, error in store.verify_all() if error is not None}
    assert len(damage) == 2
    return list(repair_artifacts(store, damage, run_again))


@pytest.mark.parametrize("damaged_file", [MANIFEST, "metrics.parquet"])
def test_what_cannot_be_removed_is_left_and_the_others_go_on(
    store: LocalStore, monkeypatch: pytest.MonkeyPatch, damaged_file: str
) -> None:
    (store.root / address(key=KEY).relative_path / damaged_file).write_bytes(b"else")
    (store.root / address(key=OTHER).relative_path / "metrics.parquet").write_bytes(b"else")
    discard = LocalStore.discard

    def refuse(opened: LocalStore, target: Artifact | Address) -> None:
        if KEY in str(target):
            raise InputError("not permitted", remedy="Give permission.")
        discard(opened, target)

    monkeypatch.setattr(LocalStore, "discard", refuse)
    found = repair(store)
    assert {(Path(done.name).name, done.outcome) for done in found} == {(KEY, "left"), (OTHER, "removed")}
    assert len(found) == 2


def test_one_that_is_damaged_again_is_not_repaired(store: LocalStore, monkeypatch: pytest.MonkeyPatch) -> None:
    for key in (KEY, OTHER):
        (store.root / address(key=key).relative_path / "metrics.parquet").write_bytes(b"else")
    discard = LocalStore.discard

    def replace(opened: LocalStore, target: Artifact | Address) -> None:
        discard(opened, target)
        # Another process computes it again meanwhile, and the disk damages what it writes.
        at = target.address if isinstance(target, Artifact) else target
        made = opened.commit(at, "evaluation", make("evaluation"))
        (made.path / (MANIFEST if at.key == KEY else "metrics.parquet")).write_bytes(b"damaged")

    monkeypatch.setattr(LocalStore, "discard", replace)
    assert [done.outcome for done in repair(store)] == ["left", "left"]
