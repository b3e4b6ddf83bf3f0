"""Lists of logs in text files, such as the splits of a dataset: ``nuscenes:PATH/@val.txt``."""

from __future__ import annotations

import re
from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.user_paths import expand_user_path

_LIST = re.compile(r"(?P<folder>.*/)@(?P<file>[^?]+)(?P<options>\?.*)?", re.DOTALL)
# The largest dataset has two thousand logs.
_MAX_BYTES = 1 << 22


def expand_log_list(uri: str) -> list[str] | None:
    """Replaces ``reader:PATH/@FILE`` by one URI for each name in a text file.

    Args:
        uri: of logs; FILE is a path of its own, or one from PATH.

    Returns:
        URIs in the order of the file, with the options behind FILE; ``None`` where no file is named. Lines that are
        empty or begin with ``#`` are no names.

    Raises:
        InputError: the file cannot be read, or has no names.

    >>> expand_log_list("nuscenes:PATH/scene-0061") is None
    True
    """
    reader, _, text = uri.partition(":")
    match = _LIST.fullmatch(text)
    # A folder may really begin with the sign.
    if match is None or expand_user_path(text).is_dir():
        return None
    above, below, _ = match["file"].partition("/")
    # So may one above the logs, such as a subvolume of a file system.
    if below and (expand_user_path(match["folder"]) / f"@{above}").is_dir():
        return None
    # As in a shell, a path counts from where the user is; a split that comes with the data lies beside the logs.
    given = expand_user_path(match["file"])
    file = given if given.exists() else expand_user_path(match["folder"]) / given
    names = _read_names(file, uri)
    return [f"{reader}:{match['folder']}{name}{match['options'] or ''}" for name in names]


def _read_names(file: Path, uri: str) -> list[str]:
    remedy = "Give a text file with the name of one log a line, as in nuscenes:PATH/@val.txt."
    try:
        if file.is_file() and file.stat().st_size > _MAX_BYTES:
            raise InputError(f"the list has more than {_MAX_BYTES} bytes", remedy=remedy, file=file, log=uri)
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"the list of logs cannot be read ({error})", remedy=remedy, file=file, log=uri) from error
    names = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not names:
        raise InputError("the list names no logs", remedy=remedy, file=file, log=uri)
    return names
