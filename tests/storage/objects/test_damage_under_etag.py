"""Damage of the server's disk: the bytes of an object differ, and its ETag says that it is as it was uploaded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from flows.pipeline.damaged_artifacts import discard_damaged_inputs, discard_if_damaged
from flows.upkeep.repair import repair_artifacts
from genre_tasks.errors import ArtifactCorruptError, GenreError
from storage.objects.object_store import ObjectStore
from storage.objects.payloads import ETAGS_START, _SoundFiles
from storage.store import Artifact
from tests.contracts.store_suite import OTHER, address
from tests.storage.artifact_values import make


@pytest.fixture
def store(bucket_uri: str) -> ObjectStore:
    return ObjectStore(bucket_uri)


def damage_under_etag(store: ObjectStore, artifact: Artifact) -> None:
    """Alters a file, and what is remembered of its ETag: a server cannot be asked to lie."""
    bucket = store._bucket
    infos = list(bucket.list(str(artifact.address)))
    (file,) = [info.name for info in infos if info.name.endswith("/metrics.parquet")]
    (known,) = [info.name for info in infos if f"/{ETAGS_START}" in info.name]
    content = bucket.read(file)
    e_tags = bucket.read(known)
    assert content is not None and e_tags is not None
    version = bucket.write(file, content.data[:-1] + bytes([content.data[-1] ^ 4]))
    bucket.write(known, json.dumps(json.loads(e_tags.data) | {"metrics.parquet": version.e_tag}).encode())


def test_only_the_bytes_show_it(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    damage_under_etag(store, made)
    store.verify(made)
    with pytest.raises(ArtifactCorruptError, match="sha256"):
        store.verify(made, reads_all=True)


def test_a_repair_removes_it_and_has_it_computed_again(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    damage_under_etag(store, made)
    record: dict[str, Any] = {"run": "aa", "log": "street", "preset": "demo", "report": "", "config": {}, "differs": {}}
    stage = {"stage": "gnet", "key": made.address.key, "cached": False, "seconds": 1.0, "metrics": {}}
    record["chunks"] = [{"chunk": 0, "stages": [stage]}]
    folder = store.records.pull("runs/aa")
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(record))
    store.records.push("runs/aa")
    again: list[str] = []

    def run_again(found: Mapping[str, Any]) -> None:
        again.append(found["run"])
        store.commit(address(), "evaluation", make("evaluation"))

    damage: dict[str, GenreError] = {name: error for name, error in store.verify_all() if error is not None}
    (repair,) = repair_artifacts(store, damage, run_again)
    assert (repair.outcome, again) == ("repaired", ["aa"])
    store.verify(made, reads_all=True)


def test_a_stage_removes_damaged_inputs_alone(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    sound = store.commit(address(key=OTHER), "evaluation", make("evaluation"))
    damage_under_etag(store, made)
    discard_damaged_inputs(store, [made.address, sound.address, address(key="c" * 64)])
    assert store.find(made.address) is None
    store.verify(sound)
    discard_if_damaged(store, sound.address)
    store.verify(sound)


def test_what_is_remembered_of_the_cache_is_bounded() -> None:
    files = _SoundFiles(max_count=2)
    one, two, three = (Path(name) for name in ("one", "two", "three"))
    stamp = ("sha256", 1, 2, 3)
    files.add(one, stamp)
    files.add(two, stamp)
    assert files.has(one, stamp) and not files.has(one, ("sha256", 1, 2, 4))
    files.add(three, stamp)
    # The one that was used least recently is gone.
    assert [files.has(path, stamp) for path in (one, two, three)] == [True, False, True]
