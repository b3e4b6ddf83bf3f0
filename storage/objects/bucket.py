"""Objects of a bucket below a prefix: read, put if absent, replaced if unchanged, and listed."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from genre_tasks.errors import InputError, TransientIOError
from storage.objects.client import check_uri, open_client, read_retry_seconds
from storage.objects.client_errors import translate_error

_MAX_PAUSE_S = 5.0
_PART_BYTES = 8 << 20
_PARTS_AT_ONCE = 4
_LIST_SIZE = 1000
_log = logging.getLogger("genre")
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
class ObjectContent:
    """An object's content.

    Attributes:
        data: the bytes.
        e_tag: changes with the content.
    """

    data: bytes
    e_tag: str


class _AbsentError(Exception):
    """There is no such object."""


class Bucket:
    """The objects below a URI such as ``s3://bucket/prefix``.

    Credentials, endpoint and region come from the environment, as the cloud's tools read them. Requests are tried
    again after pauses while the server does not answer or answers with an error of its side.

    Args:
        uri: without credentials.

    Raises:
        ConfigError: the URI names no bucket, or holds credentials or parameters.
    """

    def __init__(self, uri: str) -> None:
        self.uri = check_uri(uri)

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
            return ObjectContent(bytes(result.bytes()), result.meta["e_tag"] or "")

        try:
            return self._call(name, call)
        except _AbsentError:
            return None

    def write(self, name: str, data: bytes) -> str:
        """Writes an object over any that is there.

        Args:
            name: below the prefix.
            data: its content.

        Returns:
            The new ETag.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        import obstore

        result = self._call(name, lambda: obstore.put(self._client(), name, data))
        return result["e_tag"] or ""

    def create(self, name: str, data: bytes) -> str | None:
        """Writes an object where there is none; of two writers one succeeds.

        Args:
            name: below the prefix.
            data: its content. An object of the very same content counts as written by this call.

        Returns:
            The new ETag; ``None`` where another is there.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        return self._put_if(name, data, "create")

    def replace(self, name: str, data: bytes, e_tag: str) -> str | None:
        """Writes an object over the one that was read; of two writers one succeeds.

        Args:
            name: below the prefix.
            data: its content. It must differ from what any other writer would write.
            e_tag: of the object that was read.

        Returns:
            The new ETag; ``None`` where the object has changed or is gone.

        Raises:
            InputError: it must not be written, or the bucket is missing.
            TransientIOError: the store does not answer.
        """
        return self._put_if(name, data, {"e_tag": e_tag})

    def _put_if(self, name: str, data: bytes, mode: Any) -> str | None:
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        def call() -> str | None:
            try:
                return obstore.put(self._client(), name, data, mode=mode)["e_tag"] or ""
            except (AlreadyExistsError, PreconditionError):
                return None

        try:
            e_tag = self._call(name, call)
        except _AbsentError:
            # To be replaced, and gone.
            return None
        if e_tag is None:
            # The refusal may be the answer to a second try, after the first succeeded and its answer was lost.
            found = self.read(name)
            e_tag = found.e_tag if found is not None and found.data == data else None
        return e_tag

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
        import obstore

        def call() -> tuple[str, int]:
            digest = hashlib.sha256()
            size = 0
            with open(os.devnull if path is None else path, "wb") as out:  # noqa: PTH123
                for piece in obstore.get(self._client(), name).stream(min_chunk_size=_PART_BYTES):
                    digest.update(piece)
                    out.write(piece)
                    size += len(piece)
            return digest.hexdigest(), size

        try:
            return self._call(name, call)
        except _AbsentError as error:
            raise FileNotFoundError(name) from error

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
        except _AbsentError:
            # Some servers report a missing one, and may have stopped at it.
            for name in names if len(names) > 1 else ():
                self.delete([name])

    def _client(self) -> Any:
        return open_client(self.uri)

    def _call(self, name: str, function: Callable[[], T]) -> T:
        """Calls a function of the client; what takes longer than the client's few tries is logged and tried again."""
        from obstore.exceptions import BaseError, GenericError, NotFoundError

        start_s = time.monotonic()
        pause_s = 0.2
        while True:
            try:
                return function()
            except GenericError as error:
                problem = translate_error(error, f"{self.uri}/{name}")
                left_s = start_s + read_retry_seconds() - time.monotonic()
                if not isinstance(problem, TransientIOError) or pause_s > left_s:
                    raise problem from error
                _log.warning("%s; trying again for %.0f s", problem.problem, left_s)
            except (NotFoundError, FileNotFoundError) as error:
                # One of a file on this machine has a number.
                if isinstance(error, OSError) and error.errno is not None:
                    raise
                if "NoSuchBucket" in str(error):
                    raise InputError(
                        "there is no such bucket", remedy="Make it, or correct --store.", file=self.uri
                    ) from error
                raise _AbsentError(name) from error
            except (BaseError, PermissionError) as error:
                if isinstance(error, OSError) and error.errno is not None:
                    raise
                raise translate_error(error, f"{self.uri}/{name}") from error
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _MAX_PAUSE_S)
