"""The store in a bucket behind a line that breaks: errors of the server, lost answers, broken and endless bodies."""

from __future__ import annotations

import hashlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.operations import ObjectServer
from genre_tasks.errors import ArtifactCorruptError, InputError, TransientIOError
from storage.local import LocalStore
from storage.manifest import MANIFEST
from storage.objects.bucket import Bucket
from storage.objects.object_lease import LEASES_FOLDER
from storage.objects.object_store import ObjectStore
from tests.contracts.store_suite import KEY, address
from tests.storage.artifact_values import COLORS, assert_same, make
from tests.storage.objects.network_proxy import SOUND, Fault, FaultyProxy
from tests.waiting import wait_until

LEASE = f"{LEASES_FOLDER}/{KEY}.json"
_MIB = 1 << 20


@pytest.fixture
def proxy(bucket_uri: str, object_server: ObjectServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyProxy]:
    proxy = FaultyProxy(object_server.url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.url)
    yield proxy
    proxy.stop()


@pytest.fixture
def store(bucket_uri: str, proxy: FaultyProxy) -> ObjectStore:
    return ObjectStore(bucket_uri)


@pytest.mark.parametrize(
    "fault",
    [
        Fault(status=503, text="<Error><Code>SlowDown</Code></Error>"),
        Fault(refuses=True),
        Fault(loses_answer=True),
        Fault(upload_bytes=40),
        Fault(answer_bytes=20),
        Fault(delay_s=0.3),
    ],
    ids=["503", "refused", "lost answer", "truncated upload", "truncated answer", "slow"],
)
def test_every_other_request_fails(store: ObjectStore, proxy: FaultyProxy, tmp_path: Path, fault: Fault) -> None:
    count = itertools.count()
    proxy.choose = lambda method, path: fault if next(count) % 2 == 0 else SOUND
    value = make("novel_views")
    with store.lease(address()):
        made = store.commit(address(), "novel_views", value)
    store.verify(made)
    local = LocalStore(tmp_path / "local").commit(address(), "novel_views", value)
    assert made.manifest.files == local.manifest.files
    # As another machine reads it.
    found = store.find(address())
    assert found is not None
    (made.path / made.manifest.files[0].path).unlink()
    assert_same(value, store.read(found), "novel_views", COLORS)
    assert [error for _, error in store.verify_all()] == [None]
    assert list(store._bucket.list(LEASES_FOLDER)) == []


@pytest.mark.parametrize("part", ["manifest.json", "metrics.parquet"])
def test_an_object_that_cannot_be_read_hides_no_other(store: ObjectStore, proxy: FaultyProxy, part: str) -> None:
    keys = [f"{k:064d}" for k in range(3)]
    made = [store.commit(address(key=key), "evaluation", make("evaluation")) for key in keys]
    store._bucket.write(f"{made[2].address}/{MANIFEST}", b"damaged")
    body = '<?xml version="1.0"?>\n<Error><Code>AccessDenied</Code></Error>'
    denied = Fault(status=403, text=body)
    proxy.choose = lambda method, path: denied if keys[0] in path and path.endswith(part) else SOUND
    errors = {name.rpartition("/")[2]: error for name, error in store.verify_all()}
    assert [type(errors[key]) for key in keys] == [InputError, type(None), ArtifactCorruptError]


def test_a_store_that_is_away_ends_its_check_at_once(
    store: ObjectStore, proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for k in range(3):
        store.commit(address(key=f"{k:064d}"), "evaluation", make("evaluation"))
    monkeypatch.setenv("GENRE_STORE_RETRY_SECONDS", "1")
    checked = store.verify_all()
    assert next(checked)[1] is None
    proxy.choose = lambda method, path: Fault(refuses=True)
    assert isinstance(next(checked)[1], TransientIOError)
    with pytest.raises(TransientIOError):
        next(checked)


def test_a_store_that_is_away_for_a_while_loses_nothing(store: ObjectStore, proxy: FaultyProxy) -> None:
    end_s = time.monotonic() + 3.0
    proxy.choose = lambda method, path: Fault(refuses=True) if time.monotonic() < end_s else SOUND
    made = store.commit(address(), "evaluation", make("evaluation"))
    assert len(proxy.requests) > 1
    assert_same(make("evaluation"), store.read(made), "evaluation")


def test_a_lease_outlasts_a_store_that_is_away(
    store: ObjectStore, proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENRE_LEASE_SECONDS", "4")
    order: list[str] = []
    waiting = threading.Event()

    def wait_for_lease() -> None:
        with store.lease(address(), lambda done, total, note="": waiting.set()):
            order.append("waiter")

    waiter = threading.Thread(target=wait_for_lease)
    with store.lease(address()):
        waiter.start()
        assert waiting.wait(30)
        # Longer than the lease: its holder cannot renew it, and is not dead.
        end_s = time.monotonic() + 5.5
        proxy.choose = lambda method, path: Fault(refuses=True) if time.monotonic() < end_s else SOUND
        time.sleep(7.0)
        order.append("holder")
    waiter.join()
    assert order == ["holder", "waiter"]


def test_a_renewal_whose_answer_is_lost_keeps_the_lease(
    store: ObjectStore, proxy: FaultyProxy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("GENRE_LEASE_SECONDS", "4.5")
    with store.lease(address()):
        proxy.choose = lambda method, path: Fault(loses_answer=True) if method == "PUT" else SOUND
        wait_until(lambda: "could not be renewed" in caplog.text, "no renewal fails")
        proxy.choose = lambda method, path: SOUND
    assert "taken over" not in caplog.text
    assert list(store._bucket.list(LEASES_FOLDER)) == []


def test_a_download_goes_on_where_it_broke_off(store: ObjectStore, proxy: FaultyProxy, tmp_path: Path) -> None:
    data = b"".join(bytes([k]) * _MIB for k in range(12))
    source = tmp_path / "source"
    source.write_bytes(data)
    store._bucket.upload("large", source)
    # Each request brings a part: one that began at the front each time would never end.
    proxy.choose = lambda method, path: Fault(answer_bytes=_MIB) if "large" in path else SOUND
    digest, size = store._bucket.download("large", tmp_path / "target")
    assert (digest, size) == (hashlib.sha256(data).hexdigest(), len(data))
    assert (tmp_path / "target").read_bytes() == data
    assert store._bucket.download("large") == (digest, size)


def test_a_download_of_a_replaced_object_begins_again(store: ObjectStore, proxy: FaultyProxy, tmp_path: Path) -> None:
    new = b"new" * _MIB
    store._bucket.write("large", b"old" * _MIB)
    reads: list[str] = []

    def break_first(method: str, path: str) -> Fault:
        if method != "GET" or "large" not in path:
            return SOUND
        reads.append(path)
        if len(reads) == 1:
            return Fault(answer_bytes=_MIB)
        if len(reads) == 2:
            store._bucket.write("large", new)
        return SOUND

    proxy.choose = break_first
    assert store._bucket.download("large", tmp_path / "target") == (hashlib.sha256(new).hexdigest(), len(new))
    assert (tmp_path / "target").read_bytes() == new


@pytest.mark.parametrize(
    ("status", "code", "kind", "words"),
    [
        (501, "NotImplemented", InputError, "supports conditional writes"),
        (403, "RequestTimeTooSkewed", TransientIOError, "clock differs"),
        (403, "AccessDenied", InputError, "does not permit"),
        (301, "PermanentRedirect", InputError, "AWS_REGION"),
        (400, "ExpiredToken", InputError, "refuses"),
    ],
)
def test_what_does_not_pass_is_reported_at_once(
    store: ObjectStore, proxy: FaultyProxy, status: int, code: str, kind: type[Exception], words: str
) -> None:
    body = f'<?xml version="1.0"?>\n<Error><Code>{code}</Code></Error>'
    proxy.choose = lambda method, path: Fault(status=status, text=body)
    with pytest.raises(kind, match=words):
        store._bucket.create("one", b"data")
    # The client tries errors of the server's side a few times by itself.
    assert len(proxy.requests) <= 4


def test_no_credentials_are_reported_at_once(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    with pytest.raises(InputError, match=r"no credentials.*AWS_ACCESS_KEY_ID"):
        store.check_writable()


def test_a_long_call_may_fail_once_at_its_end(store: ObjectStore, proxy: FaultyProxy, tmp_path: Path) -> None:
    """The time to try again starts at the failure: an upload may take longer than that before it fails."""
    bucket = Bucket(store.uri, retry_s=0.5)
    source = tmp_path / "source"
    source.write_bytes(b"data" * 1000)
    requests = itertools.count()

    def choose(method: str, path: str) -> Fault:
        # More failures than the client tries by itself, the first of them after a long time.
        k = next(requests)
        return Fault(refuses=True, delay_s=1.0 if k == 0 else 0.0) if k < 4 else SOUND

    proxy.choose = choose
    bucket.upload("one", source)
    assert bucket.download("one")[1] == 4000
