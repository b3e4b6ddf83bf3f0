"""Errors of an object store's client, translated into the project's errors with a remedy."""

from __future__ import annotations

import re

from genre_tasks.errors import GenreError, InputError, TransientIOError

# Statuses of HTTP: who asks is not permitted; the request is refused; too slow, too many, or the server's fault.
_DENIED = (401, 403)
_REFUSED = 400
_PASSING = (408, 409, 425, 429)
_FAILED = 500


def translate_error(error: Exception, file: str) -> GenreError:
    """Translates an error so that a flow knows whether to retry, and a person what to do.

    Args:
        error: what the client raised.
        file: the object's address.

    Returns:
        ``InputError`` for what is refused, ``TransientIOError`` for what may pass.
    """
    from obstore.exceptions import PermissionDeniedError, UnauthenticatedError

    text = str(error).partition("\n")[0]
    # Listings report a refusal as an error of no kind.
    status = int(found[1]) if (found := re.search(r"status code: (\d{3})", text)) else 0
    is_denied = isinstance(error, PermissionDeniedError | UnauthenticatedError | PermissionError)
    if is_denied or status in _DENIED:
        return InputError(
            "the store does not permit this",
            remedy="Check the credentials in the environment, such as AWS_ACCESS_KEY_ID, and the bucket's policy.",
            file=file,
        )
    # Without the address, whose parameters may be a signature.
    reason = re.sub(r"\?[^\s\"')]+", "", text.rpartition(" - ")[2])[:200]
    if _REFUSED <= status < _FAILED and status not in _PASSING:
        return InputError(f"the store refuses this: {reason}", remedy="Check the store's URI.", file=file)
    return TransientIOError(
        f"the store does not answer: {reason}",
        remedy="Check the server, and AWS_ENDPOINT_URL or its like; then run again, finished stages are kept.",
        file=file,
    )
