"""Reads the records of finished runs, which are files that anything may have happened to since."""

from __future__ import annotations

import json
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


def _describe(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}".removeprefix(": ")
    return str(error)
