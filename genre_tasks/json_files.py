"""Reads small JSON files that come with weights and runs; whatever is wrong with one is an error that names it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from genre_tasks.errors import GenreError, InputError


def read_json_object(
    path: Path, about: str, remedy: str, stage: str | None = None, kind: type[GenreError] = InputError
) -> dict[str, Any]:
    """Reads a JSON file that holds an object.

    Args:
        path: the file.
        about: what it is, for errors, such as ``configuration of the weights``.
        remedy: what the user can do.
        stage: the stage that reads it, for errors.
        kind: the class of errors.

    Returns:
        Its values.

    Raises:
        GenreError: of that class: the file is missing, unreadable or no JSON object in UTF-8, has a key twice, or a
            number that is not finite.
    """
    try:
        values = json.loads(
            path.read_text(encoding="utf-8-sig"),
            object_pairs_hook=_refuse_duplicates,
            parse_constant=_refuse_constant,
        )
    except (OSError, ValueError, RecursionError) as error:
        # A file that is nested without end exhausts Python's stack, and its message says nothing of the file.
        reason = "it is nested too deep" if isinstance(error, RecursionError) else error
        raise kind(f"the {about} cannot be read: {reason}", remedy=remedy, file=path, stage=stage) from error
    # A list or a number is valid JSON, and would fail later with an error that names no file.
    if not isinstance(values, dict):
        raise kind(f"the {about} is no object", remedy=remedy, file=path, stage=stage)
    return values


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise ValueError(f"the key {key!r} is there twice")
        values[key] = value
    return values


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")
