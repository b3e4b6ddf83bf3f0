"""The exclusive right to compute an artifact of a bucket: an object that its holder renews, and loses when it dies."""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

from genre_tasks.errors import GenreError
from genre_tasks.progress import Progress
from genre_tasks.temporary_names import describe_owner
from storage.address import Address
from storage.objects.bucket import Bucket, ObjectVersion
from storage.objects.client import read_seconds

LEASES_FOLDER = ".leases"
"""Folder of all leases below the store's prefix."""
LEASE_VARIABLE = "GENRE_LEASE_SECONDS"
"""The environment variable for how long a lease is valid that nobody renews."""
_LEASE_S = 60.0
_RENEWALS_PER_LEASE = 3
_FIRST_POLL_S = 0.2
_MAX_POLL_S = 2.0
_SLOW_ANSWER_FRACTION = 0.1
_SHORTEST_LEASE_S = 1.0
_log = logging.getLogger("genre")


@contextmanager
def hold_object_lease(bucket: Bucket, address: Address, progress: Progress) -> Iterator[None]:
    """Waits until nobody else computes an artifact, and keeps others from it while the block runs.

    A thread renews the lease. One that was not renewed for ``GENRE_LEASE_SECONDS`` is taken over. The time is that of
    the waiting process's monotonic clock, so that no jump of a clock matters, and stands still while the store is away.

    Args:
        bucket: of the store.
        address: of the artifact.
        progress: called while another process holds the lease.

    Yields:
        Nothing.

    Raises:
        ConfigError: ``GENRE_LEASE_SECONDS`` is no number, or less than a second.
        InputError: the store cannot be written.
        TransientIOError: the store does not answer.
    """
    lease = _Lease(
        bucket, f"{LEASES_FOLDER}/{address.key}.json", read_seconds(LEASE_VARIABLE, _LEASE_S, _SHORTEST_LEASE_S)
    )
    lease.acquire(progress)
    stopped = threading.Event()
    renewal = threading.Thread(target=lease.renew_until, args=(stopped,), name="genre-lease", daemon=True)
    renewal.start()
    try:
        yield
    finally:
        stopped.set()
        renewal.join()
        lease.release()


class _Lease:
    def __init__(self, bucket: Bucket, name: str, seconds: float) -> None:
        self._bucket = bucket
        self._name = name
        self._seconds = seconds
        # Short: a renewal that fails is followed by the next one, and the end of a stage must not wait for long.
        self._renewing_bucket = bucket.with_retry_seconds(seconds / _RENEWALS_PER_LEASE)
        self._token = uuid.uuid4().hex
        self._renewals = 0
        self._version: ObjectVersion | None = None

    def acquire(self, progress: Progress) -> None:
        pause_s = _FIRST_POLL_S
        # The other's lease, and for how long it was watched without a change.
        last_version: ObjectVersion | None = None
        unchanged_s = 0.0
        read_s = time.monotonic()
        self._version = self._bucket.create(self._name, self._body())
        while self._version is None:
            found = self._bucket.read(self._name)
            waited_s = time.monotonic() - read_s
            read_s += waited_s
            # A store that was away did not let the holder renew either: only the pause counts then.
            if waited_s > pause_s + _SLOW_ANSWER_FRACTION * self._seconds:
                waited_s = pause_s
            if found is None:
                self._version = self._bucket.create(self._name, self._body())
            elif found.version != last_version:
                last_version = found.version
                unchanged_s = 0.0
            else:
                unchanged_s += waited_s
                if unchanged_s > self._seconds:
                    self._version = self._bucket.replace(self._name, self._body(), found.version)
                    if self._version is not None:
                        text = "took over the lease %s, which was not renewed for %.0f s"
                        _log.warning(text, self._name, self._seconds)
            if self._version is None:
                progress(0, 1, "another process computes this artifact")
                time.sleep(pause_s)
                pause_s = min(1.5 * pause_s, _MAX_POLL_S, self._seconds / _RENEWALS_PER_LEASE)

    def renew_until(self, stopped: threading.Event) -> None:
        interval_s = self._seconds / _RENEWALS_PER_LEASE
        pause_s = interval_s
        while self._version is not None and not stopped.wait(pause_s):
            try:
                self._renew()
                pause_s = interval_s
            except GenreError as error:
                # The store is away for everyone. The next renewal finds out whether the lease is still ours.
                _log.warning("a lease could not be renewed: %s", error)
                pause_s = min(interval_s, _MAX_POLL_S)
            if self._version is None:
                # The commit is safe without: of two writers one wins.
                _log.warning("the lease %s was taken over by another process", self._name)

    def release(self) -> None:
        try:
            if self._version is not None:
                # Renewed before it is removed, so that nobody takes it over between the two.
                self._renew()
            if self._version is not None:
                self._renewing_bucket.delete([self._name])
        except GenreError as error:
            _log.warning("a lease could not be released, and ends by itself: %s", error)

    def _renew(self) -> None:
        if self._version is None:
            return
        version = self._renewing_bucket.replace(self._name, self._next_body(), self._version)
        if version is None:
            # An earlier renewal may have arrived although its answer was lost.
            found = self._renewing_bucket.read(self._name)
            if found is not None and self._token.encode() in found.data:
                version = self._renewing_bucket.replace(self._name, self._next_body(), found.version)
        self._version = version

    def _next_body(self) -> bytes:
        self._renewals += 1
        return self._body()

    def _body(self) -> bytes:
        # The token and the counter make every body another, and so every ETag.
        body = {"owner": describe_owner(), "token": self._token, "renewals": self._renewals}
        return json.dumps(body).encode()
