"""Errors of what is written under a hidden name at first: they name the path that the user asked for."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from genre_tasks.errors import GenreError, ResourceError
from genre_tasks.temporary_names import describe_owner
from storage.io_errors import as_genre_error

# Writing to a file that is open names no file in its error, and some libraries that write give no number either.
_ERRORS_OF_UNNAMED_FILES = frozenset({None, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
_REMEDY = "Free space, or name another --out in which this user may write; nothing is half-written."


@contextmanager
def name_output(out: Path) -> Iterator[None]:
    """Makes errors of a block name ``out``, and not the hidden folder whose files take its place at the end.

    Args:
        out: what the user named by ``--out``; the hidden folder is in the same folder, or in ``out`` itself.

    Yields:
        Nothing.

    Raises:
        GenreError: as :func:`storage.io_errors.as_genre_error` makes it of an error of the disk.
    """
    try:
        yield
    except OSError as error:
        known = as_genre_error(error, out, option=None)
        is_hidden = _rename_hidden(known, out)
        is_of_file = error.filename is not None or error.errno in _ERRORS_OF_UNNAMED_FILES
        is_of_output = is_hidden or (is_of_file and Path(str(known.file)) in (out, *out.parents))
        # Of memory and file handles another folder has no more.
        if is_of_output and type(known) is not ResourceError:
            known.remedy = _REMEDY
        raise known from error
    except GenreError as error:
        _rename_hidden(error, out)
        raise


def _rename_hidden(error: GenreError, out: Path) -> bool:
    """Names ``out`` in the place of a hidden file; whether the error was of one."""
    # Only what is hidden has this in its name; a folder above, which cannot be made, is named as it is.
    if error.file is None or describe_owner() not in error.file or out.parent not in Path(error.file).parents:
        return False
    error.file = str(out)
    return True
