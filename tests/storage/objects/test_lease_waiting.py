"""Who waits for a lease takes it over from a dead holder alone, not from one who could not renew it for a while."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from storage.objects import object_lease
from storage.objects.bucket import ObjectContent, ObjectVersion
from storage.objects.object_lease import hold_object_lease
from tests.contracts.store_suite import address

OURS = ObjectVersion("ours")


class FakeBucket:
    """A bucket with another process's lease; its first reads may take long, as while the store is away."""

    def __init__(self, outage_s: float, renews_after_s: float) -> None:
        self.now_s = 0.0
        self.outages_s = [0.0, outage_s]
        self.renews_after_s = renews_after_s
        self.taken_over_s = 0.0
        self.released_s = 300.0

    def with_retry_seconds(self, retry_s: float) -> FakeBucket:
        return self

    def create(self, name: str, data: bytes) -> ObjectVersion | None:
        return OURS if self.now_s >= self.released_s else None

    def read(self, name: str) -> ObjectContent | None:
        self.now_s += self.outages_s.pop(0) if self.outages_s else 0.0
        # Every ten seconds another ETag, once the store is there again.
        renewals = max(0, int((self.now_s - self.renews_after_s) / 10))
        found = ObjectContent(b"", ObjectVersion(f"theirs {renewals}"))
        return None if self.now_s >= self.released_s else found

    def replace(self, name: str, data: bytes, version: ObjectVersion) -> ObjectVersion | None:
        self.taken_over_s = self.taken_over_s or self.now_s
        return OURS

    def delete(self, names: list[str]) -> None:
        pass

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.parametrize(
    ("outage_s", "renews_after_s", "takes_over"),
    [
        # The holder lives, and renews again when the store is there again.
        (70.0, 75.0, False),
        # It is dead.
        (0.0, 1e9, True),
        (70.0, 1e9, True),
    ],
)
def test_an_outage_makes_nobody_dead(
    outage_s: float, renews_after_s: float, takes_over: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bucket = FakeBucket(outage_s, renews_after_s)
    clock = SimpleNamespace(monotonic=lambda: bucket.now_s, sleep=bucket.sleep)
    monkeypatch.setattr(object_lease, "time", clock)
    with hold_object_lease(bucket, address(), lambda done, total, note="": None):  # type: ignore[arg-type]
        pass
    assert (0.0 < bucket.taken_over_s < bucket.released_s) == takes_over
    # Not before it was silent for its time while the store was there.
    assert not takes_over or bucket.taken_over_s >= outage_s + 60.0
