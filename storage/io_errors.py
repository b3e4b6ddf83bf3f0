"""Errors of the operating system, translated into the project's errors with a remedy."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.errors import (
    ArtifactCorruptError,
    DiskFullError,
    GenreError,
    InputError,
    ResourceError,
    TransientIOError,
)
from storage.address import Address


@dataclass(frozen=True)
class _Translation:
    """How the error numbers of one kind are reported."""

    codes: frozenset[int]
    kind: type[GenreError]
    problem: str
    remedy: str


# The class decides what a flow does: it repeats a TransientIOError after a pause, and a ResourceError with less memory
# at a time, unless it is one of those that no retry cures. Everything else stops the run.
_TRANSLATIONS = (
    _Translation(
        # No retry helps here, so the remedy says what is most feared: nothing is lost.
        frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG}),
        DiskFullError,
        "The disk is full, or a quota or file-size limit is reached ({name})",
        "Free space there or {place}; finished stages are kept, nothing is half-written.",
    ),
    _Translation(
        frozenset({errno.ENOMEM, errno.EMFILE, errno.ENFILE}),
        ResourceError,
        "The machine has no memory or file handles left ({name})",
        "Run fewer chunks at once, or raise the limit (ulimit -n).",
    ),
    _Translation(
        frozenset(
            # ESTALE, ETIMEDOUT and ENETUNREACH are how network mounts fail, EIO how some of them report it.
            {errno.EIO, errno.EAGAIN, errno.ESTALE, errno.EINTR, errno.ETIMEDOUT, errno.EBUSY, errno.ENETUNREACH}
        ),
        TransientIOError,
        "The file system did not answer properly ({name})",
        "It is tried again; if it stays, check the disk or the network mount.",
    ),
    _Translation(
        frozenset({errno.EACCES, errno.EPERM, errno.EROFS}),
        InputError,
        "Not permitted ({name})",
        "Give this user read and write permission there, or {place}.",
    ),
)
_OTHER = _Translation(
    frozenset(),
    InputError,
    "The file system refuses ({name}: {text})",
    "Check that the path is a folder, or in one, where this user can read and write, or {place}.",
)


def as_genre_error(
    error: OSError, path: Path, address: Address | None = None, option: str | None = "--store"
) -> GenreError:
    """Translates an ``OSError`` so that a flow knows whether to retry, and a person what to do.

    Args:
        error: what the operating system reported.
        path: the file or folder, for an error that names none.
        address: the artifact that was read or written, if any.
        option: which option of the command names the place, for the remedy; ``None``: not known.

    Returns:
        ``DiskFullError`` for a full disk, quota or file-size limit; ``ResourceError`` for exhausted memory or
        descriptors; ``TransientIOError`` for what may pass by itself; ``InputError`` for everything else, such as
        permissions.

    >>> print(as_genre_error(PermissionError(13, "denied"), Path("store")))
    Not permitted (EACCES) (file store). Give this user read and write permission there, ...
    """
    name = errno.errorcode.get(error.errno or 0, type(error).__name__)
    where: dict[str, object] = {"file": error.filename or path}
    if address is not None:
        where |= {"log": address.log, "chunk": address.chunk, "stage": address.stage}
    # An OSError without a number, as some libraries raise it, falls through to the general case.
    translation = next((t for t in _TRANSLATIONS if error.errno in t.codes), _OTHER)
    problem = translation.problem.format(name=name, text=error.strerror or error)
    place = "name another place" if option is None else f"choose another place with {option}"
    return translation.kind(problem, remedy=translation.remedy.format(place=place), **where)  # type: ignore[arg-type]


@contextmanager
def os_errors_translated(path: Path, address: Address | None) -> Iterator[None]:
    """Turns an ``OSError`` inside the block into one of the project's errors.

    Args:
        path: the file or folder, for an error that names none.
        address: the artifact that is read or written, if it is known.

    Yields:
        Nothing.

    Raises:
        GenreError: as :func:`as_genre_error` makes it.
    """
    try:
        yield
    except OSError as error:
        raise as_genre_error(error, path, address) from error


def make_corruption_error(address: Address, file: Path | str, problem: str) -> ArtifactCorruptError:
    """Makes the error for an artifact that cannot be trusted.

    Args:
        address: of the artifact.
        file: the damaged file, or the artifact's folder.
        problem: what is wrong with it.

    Returns:
        The error, to be raised.
    """
    return ArtifactCorruptError(
        problem,
        remedy="Run again: it is computed once more (or delete the folder by hand).",
        file=file,
        log=address.log,
        chunk=address.chunk,
        stage=address.stage,
    )
