"""The store in a bucket of a real S3 server: the contract, and what is its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from storage import manifest_writer
from storage.manifest import FileEntry
from storage.objects import payloads
from storage.objects.object_store import ObjectStore
from storage.opening import open_store
from tests.contracts.store_suite import StoreSuite


class TestObjectStore(StoreSuite):
    @pytest.fixture
    def store(self, bucket_uri: str) -> ObjectStore:
        return ObjectStore(bucket_uri)

    @pytest.fixture
    def second(self, store: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
        """As another machine opens it: with another cache."""
        monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "other-cache"))
        return open_store(store.uri)

    def test_a_store_in_a_hidden_folder_is_no_part_of_it(self, store: ObjectStore) -> None:
        inner = open_store(f"{store.uri}/.threads-2")
        made = self.commit(inner, "evaluation")
        self.commit(store, "evaluation")
        assert [found.path != made.path for found in store.artifacts()] == [True]
        assert [error for _, error in store.verify_all()] == [None]
        store.clean_temporaries(older_than_s=-60, everywhere=True)
        inner.verify(made)

    def damage(self, artifact: Any, name: str) -> None:
        bucket = self._bucket
        (info,) = [i for i in bucket.list(str(artifact.address)) if i.name.endswith(f"/{name}")]
        found = bucket.read(info.name)
        assert found is not None
        data = bytearray(found.data)
        data[len(data) // 2] ^= 4
        bucket.write(info.name, bytes(data))

    @pytest.fixture(autouse=True)
    def reach_bucket(self, store: ObjectStore) -> None:
        self._bucket = store._bucket

    def test_an_altered_file_of_the_cache_is_fetched_again(self, store: ObjectStore) -> None:
        made = self.commit(store, "evaluation")
        file = made.path / "metrics.parquet"
        sound = file.read_bytes()
        # Of the same size, as a damaged disk leaves it.
        file.write_bytes(sound[:-1] + bytes([sound[-1] ^ 4]))
        assert (store.fetch(made, ".parquet") / file.name).read_bytes() == sound

    def test_a_file_of_the_cache_is_digested_once(self, store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
        made = self.commit(store, "evaluation")
        digested: list[str] = []

        def find_damage(path: Path, entry: FileEntry) -> str | None:
            digested.append(entry.path)
            return manifest_writer.find_damage(path, entry)

        monkeypatch.setattr(payloads, "find_damage", find_damage)
        for _ in range(2):
            # As every command opens it.
            open_store(store.uri).fetch(made)
        assert sorted(digested) == sorted(entry.path for entry in made.manifest.files)
