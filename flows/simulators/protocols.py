"""Protocols by name; each is imported when it is first used."""

from __future__ import annotations

import importlib
from typing import NamedTuple, cast

from flows.simulators.service import StartService
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean


class ProtocolEntry(NamedTuple):
    """Where to find a protocol.

    Attributes:
        target: ``"module:function"``, a ``StartService``.
        port: that its clients expect.
    """

    target: str
    port: int


_PROTOCOLS: dict[str, ProtocolEntry] = {
    "alpasim": ProtocolEntry("flows.simulators.alpasim.start:start_alpasim", 50051),
    "neuroncap": ProtocolEntry("flows.simulators.neuroncap:start_neuroncap", 8000),
}


def known_protocols() -> tuple[str, ...]:
    """Lists the names of protocols.

    >>> "neuroncap" in known_protocols()
    True
    """
    return tuple(_PROTOCOLS)


def find_protocol(name: str) -> ProtocolEntry:
    """Finds a protocol by its name, without importing it.

    Args:
        name: one of :func:`known_protocols`.

    Raises:
        ConfigError: no protocol has that name.
    """
    entry = _PROTOCOLS.get(name)
    if entry is None:
        remedy = f"{did_you_mean(name, _PROTOCOLS)}Known: {', '.join(_PROTOCOLS)}."
        raise ConfigError(f"unknown protocol '{name}'", remedy=remedy)
    return entry


def load_protocol(name: str) -> StartService:
    """Loads a protocol by its name.

    Args:
        name: one of :func:`known_protocols`.

    Returns:
        What starts its service.

    Raises:
        ConfigError: no protocol has that name, or its package is not installed.
    """
    module, _, function = find_protocol(name).target.partition(":")
    try:
        return cast(StartService, getattr(importlib.import_module(module), function))
    except ModuleNotFoundError as error:
        # A missing module of our own is a fault, and no package to install.
        if (error.name or "").startswith(("flows", "genre_tasks")):
            raise
        raise ConfigError(
            f"the protocol {name} needs the package {error.name}",
            remedy="Install it: pip install 'genre[simulators]'.",
        ) from error
