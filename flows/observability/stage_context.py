"""Which log, chunk, stage and key the code that runs now is working on."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from flows.observability.redaction import redact

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


@dataclass
class StageContext:
    """What a stage works on.

    Attributes:
        log: the log's URI, without credentials.
        chunk: number of the chunk.
        stage: the stage's name.
        key: the artifact's key; empty until it is known.
    """

    log: str
    chunk: int
    stage: str
    key: str = ""


_context: ContextVar[StageContext | None] = ContextVar("genre_stage", default=None)


def get_stage_context() -> StageContext | None:
    """Gives what the running code works on.

    Returns:
        The context, or ``None`` outside of stages.
    """
    return _context.get()


@contextmanager
def enter_stage(log: str, chunk: int, stage: str) -> Iterator[StageContext]:
    """Names the stage that the block works on.

    Args:
        log: the log's URI.
        chunk: number of the chunk.
        stage: the stage's name.

    Yields:
        The context, whose key may be set once it is known.

    >>> with enter_stage("synthetic:street", 0, "gnet"):
    ...     get_stage_context()
    StageContext(log='synthetic:street', chunk=0, stage='gnet', key='')
    """
    context = StageContext(redact(log), chunk, stage)
    token = _context.set(context)
    try:
        yield context
    finally:
        _context.reset(token)


def with_stage_context(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Makes a function with the arguments ``stage``, ``chunk`` and ``job`` run in the context of that stage.

    Args:
        function: the function, such as that of a Prefect task.

    Returns:
        The same with the context.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def run(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        arguments = signature.bind(*args, **kwargs).arguments
        with enter_stage(arguments["job"].log, arguments["chunk"], arguments["stage"]):
            return function(*args, **kwargs)

    return run
