"""Reads the records of finished runs, which are files that anything may have happened to since."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from genre_tasks.errors import InputError


class _Stage(BaseModel):
    stage: str
    key: str
    cached: bool
    seconds: float
    metrics: dict[str, Any]


class _Chunk(BaseModel):
    chunk: int
    stages: list[_Stage]


class _LeftOut(BaseModel):
    chunk: int


class _Choices(BaseModel):
    chunk: int
    settings: list[str]


class _Budget(BaseModel):
    chunks: list[_Choices]


class _Record(BaseModel):
    """What every reader of a record relies on; a record has more."""

    run: str
    log: str
    preset: str
    report: str
    config: dict[str, Any]
    differs: dict[str, Any]
    chunks: list[_Chunk]
    # Records of earlier versions do not have it.
    left_out: list[_LeftOut] = []
    # Of runs within a budget.
    budget: _Budget = _Budget(chunks=[])


def read_record(path: Path) -> dict[str, Any]:
    """Reads the record of a run.

    Args:
        path: its ``run.json``.

    Returns:
        The record as plain values, with all that its readers need.

    Raises:
        InputError: the file cannot be read, or is no record of a run.
    """
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _Record.model_validate(record)
    except (OSError, ValidationError, ValueError, RecursionError) as error:
        raise InputError(
            f"the record of a run is damaged ({_describe(error)})",
            remedy="Run the log again, which writes the record anew, or delete the folder of this run.",
            file=path,
        ) from error
    return record


def read_sound_records(paths: Iterable[Path]) -> tuple[list[dict[str, Any]], dict[str, InputError]]:
    """Reads the records of runs, and goes on where one is damaged.

    Args:
        paths: of each ``run.json``.

    Returns:
        The sound records, in the order of their paths, and the errors of the damaged ones by name of the folder.
    """
    sound = []
    damaged = {}
    for path in paths:
        try:
            sound.append(read_record(path))
        except InputError as error:
            damaged[path.parent.name] = error
    return sound, damaged


def summarise_damage(damaged: Mapping[str, InputError], remedy: str = "") -> InputError:
    """Makes one error of all damaged records, for the end of a command that went on.

    Args:
        damaged: the errors, by name of the record, such as from :func:`read_sound_records`; not empty.
        remedy: what to do after the records are mended.

    Returns:
        The error, with the file and the remedy of the first one.
    """
    first = next(iter(damaged.values()))
    problem = f"{len(damaged)} records are damaged, and all else is done; the first: {first.problem}"
    return InputError(problem, remedy=f"{first.remedy} {remedy}".strip(), file=first.file)


def _describe(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}".removeprefix(": ")
    return str(error)
