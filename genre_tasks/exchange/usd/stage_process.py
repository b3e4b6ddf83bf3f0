"""Starts the process that reads a stage, and takes what it leaves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.usd.stage_dump import ARRAYS_FILE, STAGE_FILE

_MODULE = "genre_tasks.exchange.usd.stage_dump"
_BASE_S = 300.0
_S_PER_BYTE = 1e-6

_ROOT = Path(__file__).absolute().parents[3]
"""The folder that this package is in: of the checkout, or of installed packages."""


def run_stage_dump(layer: Path, folder: Path, file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads a stage in a process whose memory and time are bounded by the file's size.

    Args:
        layer: the layer that is shown.
        folder: an empty folder.
        file: the file that the user named.

    Returns:
        The stage's JSON values, and its arrays by name.

    Raises:
        InputError: the file is damaged, names other files, or asks for too much memory or time.
    """
    size = file.stat().st_size
    # One thread: each would take memory of its own. The child finds this package wherever its caller found it.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(_list_python_paths()),
        "PXR_WORK_THREAD_LIMIT": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "1",
    }
    try:
        done = subprocess.run(
            # Without -P the current folder comes first, and its numpy.py would be run.
            [sys.executable, "-P", "-m", _MODULE, str(layer.absolute()), str(folder.absolute()), str(size)],
            env=environment,
            capture_output=True,
            check=False,
            timeout=_BASE_S + _S_PER_BYTE * size,
        )
    except subprocess.TimeoutExpired as error:
        raise _damage(file) from error
    stage = folder / STAGE_FILE
    if not stage.is_file() or done.returncode:
        raise _damage(file)
    values: dict[str, Any] = json.loads(stage.read_text(encoding="utf-8"))
    if "error" in values:
        raise InputError(values["error"]["problem"], remedy=values["error"]["remedy"], file=file)
    with np.load(folder / ARRAYS_FILE, allow_pickle=False) as arrays:
        return values, {name: arrays[name] for name in arrays.files}


def _list_python_paths() -> list[str]:
    """Where this process finds modules, as absolute paths but for the current folder, which an empty one stands for."""
    paths = [str(Path(path).absolute()) for path in sys.path if path]
    # In a checkout that is not installed, the empty path may be what the package was found by.
    return paths if str(_ROOT) in paths else [str(_ROOT), *paths]


def _damage(file: Path) -> InputError:
    return InputError(
        "OpenUSD cannot read the file", remedy="Export the scene again; `usdchecker` says more.", file=file
    )
