"""Calls of an object store's client: tried again while the server does not answer, with the project's errors."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from genre_tasks.errors import InputError, TransientIOError
from storage.objects.client import read_retry_seconds
from storage.objects.client_errors import translate_error

_FIRST_PAUSE_S = 0.2
_MAX_PAUSE_S = 5.0
_log = logging.getLogger("genre")
T = TypeVar("T")


# How S3, Azure and Google Cloud Storage say that the bucket itself is missing.
_MISSING_BUCKET = ("NoSuchBucket", "ContainerNotFound", "bucket does not exist")
# S3's word for an upload in parts that somebody ended: the bucket is there.
_ENDED_UPLOAD = "NoSuchUpload"


class AbsentError(Exception):
    """There is no such object."""


@contextmanager
def absence_translated(uri: str) -> Iterator[None]:
    """Turns the absence of what is written just now into the error that its cause calls for.

    A server whose words for a missing bucket are unknown answers so.

    Args:
        uri: of the store.

    Yields:
        Nothing.

    Raises:
        InputError: there is no such bucket.
        TransientIOError: an upload in parts was ended by somebody else.
    """
    try:
        yield
    except AbsentError as error:
        if _ENDED_UPLOAD in str(error.__cause__):
            problem = "an upload was ended by the store or by somebody else"
            raise TransientIOError(problem, remedy="Run again: it is uploaded once more.", file=uri) from error
        raise _make_bucket_error(uri) from error


def _make_bucket_error(uri: str) -> InputError:
    return InputError("there is no such bucket", remedy="Make it, or correct --store.", file=uri)


def call_with_retries(
    function: Callable[[], T],
    name: str,
    uri: str,
    retry_s: float | None = None,
    measure_progress: Callable[[], int] = lambda: 0,
) -> T:
    """Calls a function of the client; what takes longer than the client's few tries is logged and tried again.

    Args:
        function: calls the client.
        name: of the object, for errors.
        uri: of the store.
        retry_s: for how long it is tried again after the first failure; by default as the environment says.
        measure_progress: how far the function came; the time starts again once that has changed.

    Returns:
        What the function returns.

    Raises:
        AbsentError: there is no such object.
        OSError: a file of this machine cannot be read or written.
        InputError: the store refuses, or the bucket is missing.
        TransientIOError: the store does not answer.
    """
    from obstore.exceptions import BaseError, GenericError, NotFoundError

    window_s = read_retry_seconds() if retry_s is None else retry_s
    # Counted from a failure and not from the call: a large file may take longer before it fails at all.
    first_failure_s: float | None = None
    progress = 0
    pause_s = _FIRST_PAUSE_S
    while True:
        try:
            return function()
        except GenericError as error:
            problem = translate_error(error, f"{uri}/{name}")
            if first_failure_s is None or measure_progress() != progress:
                first_failure_s = time.monotonic()
                progress = measure_progress()
                pause_s = _FIRST_PAUSE_S
            left_s = first_failure_s + window_s - time.monotonic()
            if not isinstance(problem, TransientIOError) or pause_s > left_s:
                raise problem from error
            _log.warning("%s; trying again for %.0f s", problem.problem, left_s)
        except (NotFoundError, FileNotFoundError) as error:
            # One of a file on this machine has a number.
            if isinstance(error, OSError) and error.errno is not None:
                raise
            if any(word in str(error) for word in _MISSING_BUCKET):
                raise _make_bucket_error(uri) from error
            raise AbsentError(name) from error
        except (BaseError, PermissionError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise translate_error(error, f"{uri}/{name}") from error
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _MAX_PAUSE_S)
