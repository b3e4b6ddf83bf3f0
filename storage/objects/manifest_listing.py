"""The manifests of a bucket's artifacts: listed, and read several at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import PurePosixPath

from genre_tasks.errors import GenreError, InputError, TransientIOError
from storage.manifest import MANIFEST
from storage.objects.bucket import Bucket, ObjectInfo
from storage.objects.payloads import find_payload_owner
from storage.objects.read_cache import ReadCache

_MANIFESTS_AT_ONCE = 16
# Dataset, log, chunk, stage, key and the manifest's name: less is a record.
_FEWEST_PARTS = 6


class ManifestListing:
    """The manifests below a store's prefix.

    Args:
        bucket: of the store.
        cache: keeps manifests that were read, under the ETag that the listing shows.
    """

    def __init__(self, bucket: Bucket, cache: ReadCache) -> None:
        self._bucket = bucket
        self._cache = cache

    def find(self, folder: str = "", key_start: str = "") -> Iterator[ObjectInfo]:
        """Lists the manifests of a folder and of all folders below it.

        Args:
            folder: below the prefix; empty for all.
            key_start: how the artifacts' keys begin.

        Yields:
            The manifests' objects.

        Raises:
            InputError: the store must not be read.
            TransientIOError: the store does not answer.
        """
        for info in self._bucket.list(folder):
            parts = PurePosixPath(info.name).parts
            # A file of a payload may have the name, too. Hidden folders and records are no artifacts.
            is_manifest = (
                parts[-1] == MANIFEST and find_payload_owner(info.name) is None and not info.name.startswith(".")
            )
            if is_manifest and len(parts) >= _FEWEST_PARTS and parts[-2].startswith(key_start):
                yield info

    def read_all(self, infos: Iterable[ObjectInfo]) -> Iterator[tuple[ObjectInfo, bytes]]:
        """Reads manifests; those that have not changed come from the cache.

        Args:
            infos: from :meth:`find`.

        Yields:
            The manifests' objects and contents, in the order of their artifacts' paths.

        Raises:
            InputError: the store must not be read.
            TransientIOError: the store does not answer.
        """
        for info, data in self.try_read_all(infos):
            if isinstance(data, GenreError):
                raise data
            yield info, data

    def try_read_all(self, infos: Iterable[ObjectInfo]) -> Iterator[tuple[ObjectInfo, bytes | GenreError]]:
        """Reads manifests; one that cannot be read does not keep those after it from being read.

        Args:
            infos: from :meth:`find`.

        Yields:
            The manifests' objects with their contents or why they cannot be read, in the order of the artifacts' paths.
        """
        # A listing is in the order of bytes, in which "-" comes before "/".
        ordered = sorted(infos, key=lambda info: PurePosixPath(info.name).parts)
        with ThreadPoolExecutor(_MANIFESTS_AT_ONCE) as pool:
            for start in range(0, len(ordered), 4 * _MANIFESTS_AT_ONCE):
                some = ordered[start : start + 4 * _MANIFESTS_AT_ONCE]
                for info, data in zip(some, pool.map(self._try_read, some), strict=True):
                    # One that is gone was discarded after the listing.
                    if data is not None:
                        yield info, data

    def _try_read(self, info: ObjectInfo) -> bytes | GenreError | None:
        try:
            return self._read(info)
        except (InputError, TransientIOError) as error:
            return error

    def _read(self, info: ObjectInfo) -> bytes | None:
        tag = hashlib.sha256(f"{info.name} {info.e_tag}".encode()).hexdigest()
        cached = self._cache.folder / "manifests" / tag[:2] / tag
        with suppress(OSError):
            return cached.read_bytes()
        found = self._bucket.read(info.name)
        if found is None:
            return None
        # Only as it was listed: the name of the file says so.
        if found.version.e_tag == info.e_tag:
            with suppress(OSError), self._cache.temporary() as temporary:
                (temporary / "manifest").write_bytes(found.data)
                cached.parent.mkdir(parents=True, exist_ok=True)
                (temporary / "manifest").replace(cached)
        return found.data
