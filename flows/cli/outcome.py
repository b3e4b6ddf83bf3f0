"""How a command ended, for programs: with ``--json`` one object on stdout in every outcome.

Every object has ``status``, ``exit_code`` and ``error``; what else it has is the command's. The page of errors in docs/
lists the fields.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import typer

from flows.error_record import record_error

if TYPE_CHECKING:
    from genre_tasks.errors import GenreError

Status = Literal["done", "partly_done", "refused", "failed", "interrupted"]
EXIT_CODES: Mapping[Status, int] = {"done": 0, "partly_done": 1, "refused": 2, "failed": 1, "interrupted": 130}
"""The exit status of each outcome. A fault of the program has its own, see :mod:`flows.cli.last_resort`."""


@dataclass
class _Progress:
    """What is known of the running command before it ends.

    Attributes:
        as_json: whether the user asked for JSON.
        is_printed: whether the object is printed already.
        facts: entries of the object.
        stages: by chunk, the finished stages.
    """

    as_json: bool = False
    is_printed: bool = False
    facts: dict[str, Any] = field(default_factory=dict)
    stages: dict[int, list[dict[str, Any]]] = field(default_factory=dict)


# One for the process, as a process runs one command; a signal may end it anywhere.
_progress = _Progress()


def start_outcome(as_json: bool) -> None:
    """Forgets what an earlier command has left, and notes whether this one is to print JSON.

    Args:
        as_json: whether the user asked for JSON.
    """
    global _progress
    _progress = _Progress(as_json=as_json)


def add_facts(**facts: Any) -> None:
    """Adds entries to the object that is printed if the command does not come to its end.

    Args:
        facts: JSON values by name.
    """
    _progress.facts.update(facts)


def add_stage(chunk: int, stage: str, key: str, cached: bool) -> None:
    """Adds a finished stage to the object that is printed if the command does not come to its end.

    Args:
        chunk: number of the chunk.
        stage: the stage's name.
        key: the artifact's key.
        cached: whether the artifact was in the store already.
    """
    stages = _progress.stages.setdefault(chunk, [])
    stages.append({"stage": stage, "key": key, "cached": cached})


def print_outcome(
    status: Status, facts: Mapping[str, Any], error: GenreError | None = None, exit_code: int | None = None
) -> None:
    """Prints the one object of a command that has come to its end.

    Args:
        status: how it ended.
        facts: what the command has to report.
        error: what is wrong, if anything is.
        exit_code: the exit status, where it is not the one of ``status``.
    """
    code = EXIT_CODES[status] if exit_code is None else exit_code
    _print({"status": status, "exit_code": code, "error": error and record_error(error), **facts})


def print_unfinished(status: Status, exit_code: int, error: Mapping[str, Any] | None = None) -> None:
    """Prints the one object of a command that did not come to its end, if JSON is wanted and none is printed yet.

    Args:
        status: how it ended.
        exit_code: its exit status.
        error: what is wrong, as :func:`flows.error_record.record_error` gives it.
    """
    if _progress.as_json and not _progress.is_printed:
        chunks = [{"chunk": chunk, "stages": stages} for chunk, stages in sorted(_progress.stages.items())]
        done = {"chunks": chunks} if chunks else {}
        _print({"status": status, "exit_code": exit_code, "error": error, **_progress.facts, **done})


def wants_json(command: Any, words: Sequence[str]) -> bool:
    """Finds out whether JSON is wanted, also where the command line cannot be parsed.

    Args:
        command: the group of all commands.
        words: the command line without the program's name.

    Returns:
        Whether the named command has a flag ``--json``, and the words hold it. For ``bench`` it names a file.
    """
    options = list(words[: words.index("--")] if "--" in words else words)
    subcommand = command
    # Some commands are groups of further ones, such as `store`.
    for word in options:
        subcommand = getattr(subcommand, "commands", {}).get(word, subcommand)
    flags = [name for p in getattr(subcommand, "params", ()) if getattr(p, "is_flag", False) for name in p.opts]
    return "--json" in options and "--json" in flags


def _print(values: Mapping[str, Any]) -> None:
    # Noted first: a signal that comes while it is printed must not print a second one.
    _progress.is_printed = True
    typer.echo(json.dumps(_to_json(values), default=str))


def _to_json(value: Any) -> Any:
    """The value without NaN and infinity, which JSON does not have: they become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _to_json(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(entry) for entry in value]
    return value
