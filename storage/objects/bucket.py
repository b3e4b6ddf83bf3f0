"""Objects of a bucket below a prefix: read, put if absent, replaced if unchanged, and listed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from storage.objects.client import check_uri, open_client
from storage.objects.download import Download
from storage.objects.retries import AbsentError, absence_translated, call_with_retries

_PART_BYTES = 8 << 20
_PARTS_AT_ONCE = 4
_LIST_SIZE = 1000
T = TypeVar("T")


@dataclass(frozen=True)
class ObjectInfo:
    """What a listing says of an object.

    Attributes:
        name: below the bucket's prefix, with "/" between its parts.
        size: bytes.
        e_tag: changes with the content.
        modified: when it was written, by the server's clock.
    """

    name: str
    size: int
    e_tag: str
    modified: datetime


@dataclass(frozen=True)
class ObjectVersion:
    """Names one content that an object has or had.

    Attributes:
        e_tag: changes with the content; S3 and Azure compare it.
        generation: counts the writes, where the server does; Google Cloud Storage compares it and no ETag.
    """

    e_tag: str
    generation: str | None = None


@dataclass(frozen=True)
class ObjectContent:
    """An object's content.

    Attributes:
        data: the bytes.
        version: of this content.
    """

    data: bytes
    version: ObjectVersion


class Bucket:
    """The objects below a URI such as ``s3://bucket/prefix``.

    Credentials, endpoint and region come from the environment, as the cloud's tools read them. Requests are tried
    again after pauses while the server does not answer or answers with an error of its side.

    Args:
        uri: without credentials.
        retry_s: for how long a request is tried again; by default as the environment says.

    Raises:
        ConfigError: the URI names no bucket, or holds credentials or parameters.
    """

    def __init__(self, uri: str, retry_s: float | None = None) -> None:
        self.uri = check_uri(uri)
        self._retry_s = retry_s

    def with_retry_seconds(self, retry_s: float) -> Bucket:
        """Makes another access to the same objects.

        Args:
            retry_s: for how long a request is tried again.

        Returns:
            The access.
        """
        return Bucket(self.uri, retry_s)

    def read(self, name: str) -> ObjectContent | None:
        """Reads a small object.

        Args:
            name: below the prefix.

        Returns:
            Its content; ``None`` where there is none.

        Raises:
            InputError: it must not be read, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        def call() -> ObjectContent:
            result = obstore.get(self._client(), name)
            return ObjectContent(bytes(result.bytes()), _version_of(result.meta))

        try:
            return self._call(name, call)
        except AbsentError:
            return None

    def write(self, name: str, data: bytes) -> ObjectVersion:
        """Writes an object over any that is there.

        Args:
            name: below the prefix.
            data: its content.

        Returns:
            The new version.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        with absence_translated(self.uri):
            return _version_of(self._call(name, lambda: obstore.put(self._client(), name, data)))

    def create(self, name: str, data: bytes) -> ObjectVersion | None:
        """Writes an object where there is none; of two writers one succeeds.

        Args:
            name: below the prefix.
            data: its content. An object of the very same content counts as written by this call.

        Returns:
            The new version; ``None`` where another is there.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        with absence_translated(self.uri):
            return self._put_if(name, data, "create")

    def replace(self, name: str, data: bytes, version: ObjectVersion) -> ObjectVersion | None:
        """Writes an object over the one that was read; of two writers one succeeds.

        Args:
            name: below the prefix.
            data: its content. It must differ from what any other writer would write.
            version: of the object that was read.

        Returns:
            The new version; ``None`` where the object has changed or is gone.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        # Both, where the server has both: each cloud compares another one. The client takes no None.
        named = {"e_tag": version.e_tag, "version": version.generation}
        try:
            return self._put_if(name, data, {key: value for key, value in named.items() if value})
        except AbsentError:
            # It is gone.
            return None

    def _put_if(self, name: str, data: bytes, mode: Any) -> ObjectVersion | None:
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        def call() -> ObjectVersion | None:
            try:
                return _version_of(obstore.put(self._client(), name, data, mode=mode))
            except (AlreadyExistsError, PreconditionError):
                return None

        version = self._call(name, call)
        if version is None:
            # The refusal may be the answer to a second try, after the first succeeded and its answer was lost.
            found = self.read(name)
            version = found.version if found is not None and found.data == data else None
        return version

    def upload(self, name: str, path: Path) -> str:
        """Writes a file as an object, in parts where it is large.

        Args:
            name: below the prefix.
            path: the file.

        Returns:
            The new ETag.

        Raises:
            OSError: the file cannot be read.
            InputError: the object must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        def call() -> str:
            result = obstore.put(self._client(), name, path, chunk_size=_PART_BYTES, max_concurrency=_PARTS_AT_ONCE)
            return result["e_tag"] or ""

        with absence_translated(self.uri):
            return self._call(name, call)

    def download(self, name: str, path: Path | None = None) -> tuple[str, int]:
        """Reads an object of any size in pieces.

        Args:
            name: below the prefix.
            path: the file to write; it appears half-written first. ``None`` to digest the object only.

        Returns:
            The sha256 of what was read, and its size in bytes.

        Raises:
            FileNotFoundError: there is no such object.
            OSError: the file cannot be written.
            InputError: the object must not be read, or the bucket is missing.
            TransientIOError: the store does not answer, or breaks off every time.
        """
        out = None if path is None else path.open("wb")
        download = Download(self.uri, name, out)
        try:
            digest = self._call(name, download.run, lambda: download.size)
        except AbsentError as error:
            raise FileNotFoundError(name) from error
        finally:
            # What was not written yet may find the disk full, which is an error too.
            if out is not None:
                out.close()
        return digest, download.size

    def list(self, folder: str = "", start: str = "") -> Iterator[ObjectInfo]:
        """Lists the objects of a folder and of all folders below it.

        Args:
            folder: below the prefix; empty for all.
            start: how the name goes on after the folder, to the letter.

        Yields:
            The objects, those of one folder after another.

        Raises:
            InputError: they must not be listed, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        wanted = f"{folder}/{start}" if folder else start
        # A prefix of an object store ends at a "/", so the offset skips to the names that begin as wanted. Without the
        # last letter, as a server may skip a folder of exactly this name.
        offset = wanted[:-1] if len(start) > 1 else None
        seen: set[str] = set()
        pages: Iterator[Sequence[Any]] = iter(())
        is_open = False

        def next_page() -> Sequence[Any]:
            # Opened again after an error: what was listed before is then skipped.
            nonlocal pages, is_open
            if not is_open:
                pages = iter(obstore.list(self._client(), folder or None, offset=offset, chunk_size=_LIST_SIZE))
            is_open = False
            page = next(pages, ())
            is_open = True
            return page

        while page := self._call(folder, next_page):
            for meta in page:
                name = meta["path"]
                if name in seen:
                    continue
                # Not by comparing with the last one: servers differ in the order of "a.b" and "a/b".
                seen.add(name)
                if name.startswith(wanted):
                    yield ObjectInfo(name, meta["size"], meta["e_tag"] or "", meta["last_modified"])
                elif start and name > wanted:
                    return

    def delete(self, names: Sequence[str]) -> None:
        """Removes objects; nothing happens for one that is not there.

        Args:
            names: below the prefix.

        Raises:
            InputError: they must not be removed, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        if not names:
            return
        try:
            self._call(names[0], lambda: obstore.delete(self._client(), list(names)))
        except AbsentError:
            # Some servers report a missing one, and may have stopped at it.
            for name in names if len(names) > 1 else ():
                self.delete([name])

    def _client(self) -> Any:
        return open_client(self.uri)

    def _call(self, name: str, function: Callable[[], T], measure_progress: Callable[[], int] = lambda: 0) -> T:
        return call_with_retries(function, name, self.uri, self._retry_s, measure_progress)


def _version_of(meta: Any) -> ObjectVersion:
    return ObjectVersion(meta["e_tag"] or "", meta["version"])
