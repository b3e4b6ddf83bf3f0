"""The store in a bucket when something goes wrong: dead holders of leases, broken uploads, a full cache, refusals."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from genre_tasks.errors import ArtifactCorruptError, ConfigError, InputError, TransientIOError
from storage.manifest import MANIFEST
from storage.objects.bucket import Bucket, ObjectVersion
from storage.objects.object_lease import LEASES_FOLDER
from storage.objects.object_store import ObjectStore
from storage.opening import open_store
from tests.contracts.store_suite import KEY, OTHER, address
from tests.storage.artifact_values import assert_same, make

HOLDER = """
import sys, time
from storage.opening import open_store
from tests.contracts.store_suite import address
with open_store(sys.argv[1]).lease(address()):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def store(bucket_uri: str) -> ObjectStore:
    return ObjectStore(bucket_uri)


def test_a_killed_process_loses_its_lease(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_LEASE_SECONDS", "3")
    with subprocess.Popen([sys.executable, "-c", HOLDER, store.uri], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        waited: list[str] = []
        end_s = time.monotonic() + 4.5
        # While it lives it renews: the lease outlasts its time.
        with (
            pytest.raises(TimeoutError),
            store.lease(address(), lambda done, total, note="": _wait_until(end_s, waited)),
        ):
            pass
        holder.kill()
    with store.lease(address(), lambda done, total, note="": waited.append(note)):
        assert [info.name for info in store._bucket.list(LEASES_FOLDER)] == [f"{LEASES_FOLDER}/{KEY}.json"]
    assert waited and list(store._bucket.list(LEASES_FOLDER)) == []


def _wait_until(end_s: float, waited: list[str]) -> None:
    waited.append("")
    if time.monotonic() > end_s:
        raise TimeoutError


def test_a_holder_that_lost_its_lease_leaves_the_new_one_alone(store: ObjectStore) -> None:
    with store.lease(address()):
        name = f"{LEASES_FOLDER}/{KEY}.json"
        found = store._bucket.read(name)
        assert found is not None
        assert store._bucket.replace(name, b"of another", found.version) is not None
    assert (left := store._bucket.read(name)) is not None and left.data == b"of another"


def test_of_two_that_write_one_succeeds(store: ObjectStore) -> None:
    bucket = store._bucket
    start = threading.Barrier(8)
    results: list[ObjectVersion | None] = []

    def create(k: int) -> None:
        start.wait()
        results.append(bucket.create("one", b"%d" % k))

    threads = [threading.Thread(target=create, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(version is not None for version in results) == 1
    # The same content counts as written: the answer to the first try may have been lost.
    found = bucket.read("one")
    assert found is not None and bucket.create("one", found.data) == found.version
    assert bucket.replace("one", b"new", ObjectVersion("wrong")) is None
    assert bucket.replace("none", b"new", found.version) is None


def test_a_truncated_upload_is_written_again(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    upload = Bucket.upload
    truncated: list[str] = []

    def truncate_once(self: Bucket, name: str, path: Path) -> str:
        if truncated:
            return upload(self, name, path)
        truncated.append(name)
        return self.write(name, path.read_bytes()[:-1]).e_tag

    monkeypatch.setattr(Bucket, "upload", truncate_once)
    made = store.commit(address(), "evaluation", make("evaluation"))
    assert truncated
    store.verify(made)
    assert_same(make("evaluation"), store.read(made), "evaluation")


def test_a_server_that_keeps_nothing_is_named(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bucket, "upload", lambda self, name, path: self.write(name, b"").e_tag)
    with pytest.raises(TransientIOError, match="does not keep what is written"):
        store.commit(address(), "evaluation", make("evaluation"))
    assert store.find(address()) is None


def test_no_manifest_no_artifact(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    store._bucket.delete([f"{address()}/{MANIFEST}"])
    assert store.find(address()) is None and list(store.artifacts()) == []
    # What is left of it goes, and nothing of another one.
    other = store.commit(address(key=OTHER), "evaluation", make("evaluation"))
    assert store.clean_temporaries(older_than_s=-60, everywhere=True) > 0
    assert not list(store._bucket.list(str(address())))
    store.verify(other)
    with pytest.raises(ArtifactCorruptError, match="missing"):
        store.verify(made)


def test_the_cache_keeps_its_bound(bucket_uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENRE_CACHE_GB", "0.00004")
    monkeypatch.setattr("storage.objects.read_cache._IN_USE_S", 0.0)
    store = open_store(bucket_uri)
    made = [store.commit(address(key=f"{k:064d}"), "evaluation", make("evaluation", k)) for k in range(6)]
    sizes = [path.stat().st_size for path in (tmp_path / "cache").rglob("*.parquet")]
    assert 0 < sum(sizes) <= 40_000 < sum(entry.size for artifact in made for entry in artifact.manifest.files)
    # What went comes back.
    for k, artifact in enumerate(made):
        assert_same(make("evaluation", k), store.read(artifact), "evaluation")


def test_a_damaged_file_of_the_cache_comes_again(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    (made.path / "metrics.parquet").write_bytes(b"else")
    assert_same(make("evaluation"), store.read(made), "evaluation")


@pytest.mark.parametrize("uri", ["s3://name:secret@bucket/x", "s3://bucket/x?sig=secret", "s3://bucket/x#secret"])
def test_credentials_in_a_uri_are_refused_and_not_repeated(uri: str) -> None:
    with pytest.raises(ConfigError, match="holds credentials") as caught:
        open_store(uri)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("uri", ["s3://", "ftp://bucket/x", "s3://bucket/../x", "s3://bucket/a//b"])
def test_uris_of_no_store_are_refused(uri: str) -> None:
    with pytest.raises(ConfigError, match="of no known kind"):
        open_store(uri)


def test_wrong_keys_are_a_clear_error(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    start_s = time.monotonic()
    for call in (store.check_writable, store.exists, lambda: store.find(address())):
        with pytest.raises(InputError, match=r"does not permit.*AWS_ACCESS_KEY_ID"):
            call()
    # At once: no second try helps.
    assert time.monotonic() - start_s < 9.0


def test_a_server_that_is_away_is_waited_for(bucket_uri: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("GENRE_STORE_RETRY_SECONDS", "1")
    with pytest.raises(TransientIOError, match=r"does not answer.*AWS_ENDPOINT_URL"):
        open_store(bucket_uri).find(address())
