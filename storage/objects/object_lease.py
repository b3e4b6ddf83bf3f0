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
from storage.objects.bucket import Bucket
from storage.objects.client import read_seconds

LEASES_FOLDER = ".leases"
"""Folder of all leases below the store's prefix."""
LEASE_VARIABLE = "GENRE_LEASE_SECONDS"
"""The environment variable for how long a lease is valid that nobody renews."""
_LEASE_S = 60.0
_RENEWALS_PER_LEASE = 3
_FIRST_POLL_S = 0.2
_MAX_POLL_S = 2.0
_log = logging.getLogger("genre")


@contextmanager
def hold_object_lease(bucket: Bucket, address: Address, progress: Progress) -> Iterator[None]:
    """Waits until nobody else computes an artifact, and keeps others from it while the block runs.

    A thread renews the lease. One that was not renewed for ``GENRE_LEASE_SECONDS`` is taken over. The time is that of
    the waiting process's monotonic clock, so that no jump of a clock matters.

    Args:
        bucket: of the store.
        address: of the artifact.
        progress: called while another process holds the lease.

    Yields:
        Nothing.

    Raises:
        ConfigError: ``GENRE_LEASE_SECONDS`` is no number.
        InputError: the store cannot be written.
        TransientIOError: the store does not answer.
    """
    lease = _Lease(bucket, f"{LEASES_FOLDER}/{address.key}.json", read_seconds(LEASE_VARIABLE, _LEASE_S))
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
        self._token = uuid.uuid4().hex
        self._renewals = 0
        self._e_tag: str | None = None

    def acquire(self, progress: Progress) -> None:
        pause_s = _FIRST_POLL_S
        # The ETag of the other's lease, and when it was first read.
        last_e_tag = ""
        since_s = time.monotonic()
        last_read_s = since_s
        while True:
            self._e_tag = self._bucket.create(self._name, self._body())
            if self._e_tag is not None:
                return
            found = self._bucket.read(self._name)
            now_s = time.monotonic()
            # A store that was away was so for the holder too, who could not renew, and lives.
            was_away = now_s - last_read_s > self._seconds / _RENEWALS_PER_LEASE
            last_read_s = now_s
            if found is None:
                continue
            if found.e_tag != last_e_tag or was_away:
                last_e_tag = found.e_tag
                since_s = now_s
            elif time.monotonic() - since_s > self._seconds:
                self._e_tag = self._bucket.replace(self._name, self._body(), found.e_tag)
                if self._e_tag is not None:
                    _log.warning("took over the lease %s, which was not renewed for %.0f s", self._name, self._seconds)
                    return
            progress(0, 1, "another process computes this artifact")
            time.sleep(pause_s)
            pause_s = min(1.5 * pause_s, _MAX_POLL_S, max(self._seconds / _RENEWALS_PER_LEASE, _FIRST_POLL_S))

    def renew_until(self, stopped: threading.Event) -> None:
        while not stopped.wait(self._seconds / _RENEWALS_PER_LEASE):
            if self._e_tag is None:
                return
            self._renewals += 1
            try:
                self._e_tag = self._bucket.replace(self._name, self._body(), self._e_tag)
            except GenreError as error:
                # The store is away for everyone. The next renewal finds out whether the lease is still ours.
                _log.warning("a lease could not be renewed: %s", error)
                continue
            if self._e_tag is None:
                # The commit is safe without: of two writers one wins.
                _log.warning("the lease %s was taken over by another process", self._name)

    def release(self) -> None:
        if self._e_tag is None:
            return
        try:
            # Only if it is ours. Between the two calls nobody takes it over, as it was renewed just now.
            found = self._bucket.read(self._name)
            if found is not None and found.e_tag == self._e_tag:
                self._bucket.delete([self._name])
        except GenreError as error:
            _log.warning("a lease could not be released, and ends by itself: %s", error)

    def _body(self) -> bytes:
        # The token and the counter make every body another, and so every ETag.
        body = {"owner": describe_owner(), "token": self._token, "renewals": self._renewals}
        return json.dumps(body).encode()
