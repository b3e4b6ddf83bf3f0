"""Two that write, repair or remove one artifact of a bucket at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from genre_tasks.errors import ConfigError
from storage.manifest import MANIFEST
from storage.objects.object_store import ObjectStore
from storage.objects.payloads import PAYLOAD_START, Payloads
from storage.store import Provenance
from tests.contracts.store_suite import OTHER, address
from tests.storage.artifact_values import assert_same, make

WRITER = """
import sys
from storage.opening import open_store
from tests.contracts.store_suite import address
from tests.storage.artifact_values import make
store = open_store(sys.argv[1])
value = make("evaluation", int(sys.argv[2]))
print("ready", flush=True)
sys.stdin.readline()
print(store.commit(address(), "evaluation", value).manifest.payload_digest)
"""
FORKING = """
import os, sys
from storage.opening import open_store
open_store(sys.argv[1]).exists()
child = os.fork()
if child == 0:
    try:
        open_store(sys.argv[1]).exists()
    except Exception as error:
        print(type(error).__name__, error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
"""


@pytest.fixture
def store(bucket_uri: str) -> ObjectStore:
    return ObjectStore(bucket_uri)


def test_of_two_processes_with_other_bytes_one_wins(store: ObjectStore) -> None:
    writers = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, store.uri, str(k)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for k in range(2)
    ]
    for writer in writers:
        assert writer.stdout is not None and writer.stdout.readline() == "ready\n"
    for writer in writers:
        assert writer.stdin is not None
        writer.stdin.write("go\n")
        writer.stdin.flush()
    digests = {writer.communicate(timeout=60)[0].strip() for writer in writers}
    found = store.find(address())
    assert found is not None and digests == {found.manifest.payload_digest}
    store.verify(found)
    # The loser removed its files.
    names = [info.name for info in store._bucket.list(str(address()))]
    digest = found.manifest.payload_digest[:12]
    assert all(f"/{PAYLOAD_START}{digest}/" in name for name in names if PAYLOAD_START in name)


def test_a_repair_replaces_no_artifact_of_another(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    damaged = store.commit(address(), "evaluation", make("evaluation"))
    (info,) = [info for info in store._bucket.list(str(address())) if info.name.endswith("metrics.parquet")]
    store._bucket.write(info.name, b"else")
    upload = Payloads.upload
    repaired = []

    def upload_late(payloads: Payloads, folder: Path, manifest: object) -> None:
        # After this one found the damage, and before it writes, another one has repaired it.
        monkeypatch.setattr(Payloads, "upload", upload)
        repaired.append(store.commit(address(), "evaluation", make("evaluation", 1)))
        upload(payloads, folder, manifest)  # type: ignore[arg-type]

    monkeypatch.setattr(Payloads, "upload", upload_late)
    late = store.commit(address(), "evaluation", make("evaluation"), Provenance(warnings=("late",)))
    assert late.manifest == repaired[0].manifest != damaged.manifest
    store.verify(late)
    assert_same(make("evaluation", 1), store.read(late), "evaluation")


def test_a_file_that_does_not_belong_goes_at_the_repair(store: ObjectStore) -> None:
    made = store.commit(address(), "evaluation", make("evaluation"))
    (info,) = [info for info in store._bucket.list(str(address())) if info.name.endswith("metrics.parquet")]
    store._bucket.write(f"{info.name}.more", b"more")
    again = store.commit(address(), "evaluation", make("evaluation"), Provenance(warnings=("again",)))
    store.verify(again)
    assert again.manifest.files == made.manifest.files and again.manifest.warnings == ("again",)


def test_hidden_objects_among_records_are_left_out(store: ObjectStore) -> None:
    for name in ("runs/aa/run.json", "runs/aa/.DS_Store", "runs/.tmp-x/run.json"):
        store._bucket.write(name, name.encode())
    assert sorted(path.name for path in store.records.pull("runs/aa").iterdir()) == [".sync.json", "run.json"]
    assert [path.read_text() for path in store.records.find("runs", "run.json")] == ["runs/aa/run.json"]


def test_leases_and_uploads_at_work_are_no_leftovers(store: ObjectStore) -> None:
    store.commit(address(), "evaluation", make("evaluation"))
    store._bucket.delete([f"{address()}/{MANIFEST}"])
    with store.lease(address(key=OTHER)):
        before = {info.name for info in store._bucket.list()}
        store.clean_temporaries(older_than_s=60.0, everywhere=True)
        assert {info.name for info in store._bucket.list()} == before


def test_a_forked_process_is_refused_and_does_not_hang(store: ObjectStore) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKING, store.uri], capture_output=True, text=True, timeout=60, check=True
    )
    assert ConfigError.__name__ in done.stdout and "spawn" in done.stdout


@pytest.mark.parametrize("uri", ["s3://name:sec/ret@bucket/x", "s3://name:sec/ret@bucket", "s3://[::1/ret"])
def test_secrets_with_a_slash_are_not_repeated(uri: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ObjectStore(uri)
    assert "ret" not in str(caught.value)
