"""What the operating system says, as the project's errors with a remedy."""

from __future__ import annotations

import errno
from pathlib import Path

from genre_tasks.errors import GenreError, InputError, ResourceError, TransientIOError
from storage.address import Address

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_PASSING = {errno.EIO, errno.EAGAIN, errno.ESTALE, errno.EINTR, errno.ETIMEDOUT, errno.EBUSY, errno.ENETUNREACH}
_EXHAUSTED = {errno.ENOMEM, errno.EMFILE, errno.ENFILE}
_DENIED = {errno.EACCES, errno.EPERM, errno.EROFS}


def as_genre_error(error: OSError, path: Path, address: Address | None = None) -> GenreError:
    """The project's error for an ``OSError`` at ``path``.

    A full disk, quota or file-size limit and exhausted memory or descriptors are ``ResourceError``; what may pass by
    itself is ``TransientIOError``; all else (permissions, a file where a folder should be) is ``InputError``.
    """
    name = errno.errorcode.get(error.errno or 0, type(error).__name__)
    file = error.filename or path
    known: dict[str, object] = {"file": file}
    if address is not None:
        known |= {"log": address.log, "chunk": address.chunk, "stage": address.stage}
    kind: type[GenreError]
    if error.errno in _FULL:
        kind, problem = ResourceError, f"The disk is full, or a quota or file-size limit is reached ({name})"
        remedy = (
            "Free space there or choose another place with --store; finished stages are kept, nothing is half-written."
        )
    elif error.errno in _EXHAUSTED:
        kind, problem = ResourceError, f"The machine has no memory or file handles left ({name})"
        remedy = "Run fewer chunks at once, or raise the limit (ulimit -n)."
    elif error.errno in _PASSING:
        kind, problem = TransientIOError, f"The file system did not answer properly ({name})"
        remedy = "It is tried again; if it stays, check the disk or the network mount."
    elif error.errno in _DENIED:
        kind, problem = InputError, f"Not permitted ({name})"
        remedy = "Give this user read and write permission there, or choose another place with --store."
    else:
        kind, problem = InputError, f"The file system refuses ({name}: {error.strerror or error})"
        remedy = "Check that the path of the store is a folder that this user can write to."
    return kind(problem, remedy=remedy, **known)  # type: ignore[arg-type]
