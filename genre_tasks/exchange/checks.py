"""Checks that all formats share: of files before memory is taken for them, and of values that must be finite."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.types import Float32

CLOUD_ATTRIBUTES = ("means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest")
"""Names of the arrays of a :class:`SplatCloud`."""

_SOUND_FILE = "Export the file again, or give a file that is complete."


def measure_file(path: Path) -> int:
    """Gives a file's size, which bounds the memory that reading it may take.

    Args:
        path: of the file.

    Returns:
        Bytes.

    Raises:
        InputError: there is no such file, or it is a folder.
    """
    try:
        # Opened and not only looked at: a file without permission to read is found here too.
        with path.open("rb") as stream:
            return stream.seek(0, 2)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"cannot read the file: {reason}", remedy="Check the path.", file=path) from error


def read_file(path: Path, most_bytes: int | None = None) -> bytes:
    """Reads a file, or its beginning.

    Args:
        path: of the file.
        most_bytes: how much of it at most; ``None``: all.

    Returns:
        The bytes.

    Raises:
        InputError: there is no such file, or it is a folder.
    """
    size = measure_file(path)
    with path.open("rb") as stream:
        return stream.read(size if most_bytes is None else min(size, most_bytes))


def check_claimed_size(path: Path, claimed: int, available: int, what: str) -> None:
    """Checks that a file is as long as its header claims, before memory is taken for what it claims.

    Args:
        path: of the file, for the error.
        claimed: bytes that the header's counts ask for.
        available: bytes that are there.
        what: what the bytes hold, such as ``1000 Gaussians``.

    Raises:
        InputError: fewer bytes are there.
    """
    if claimed > available:
        problem = f"the file is cut off: {what} need {claimed} bytes, and {available} are there"
        raise InputError(problem, remedy=_SOUND_FILE, file=path)


def check_finite_values(path: Path, attribute: str, values: Float32, first_row: int = 0) -> None:
    """Checks that an attribute of Gaussians is finite.

    Args:
        path: of the file, for the error.
        attribute: its name there or in a :class:`SplatCloud`.
        values: [N, ...].
        first_row: which Gaussian of the file ``values[0]`` is.

    Raises:
        InputError: with the attribute, how many Gaussians are not finite in it, and the first of them.
    """
    finite = np.isfinite(values)
    if finite.all():
        return
    bad = np.flatnonzero(~finite.reshape(len(values), -1).all(1))
    problem = f"{attribute} is not finite in {len(bad)} Gaussians, the first is number {first_row + bad[0]} from 0 on"
    raise InputError(problem, remedy=_SOUND_FILE, file=path)


def check_finite_cloud(path: Path, cloud: SplatCloud) -> None:
    """Checks that all attributes of a cloud are finite.

    Args:
        path: of the file that it was read from or is written to, for the error.
        cloud: any.

    Raises:
        InputError: as :func:`check_finite_values`, for the first attribute that is not finite.
    """
    for name in CLOUD_ATTRIBUTES:
        check_finite_values(path, name, getattr(cloud, name))
