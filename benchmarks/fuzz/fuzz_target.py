"""A reader of files that others may have written, with valid files of its format and the damages that suit it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz.fuzz_mutations import Mutation

MEMORY_MIB = 256
"""Reading a small file may add so much to the process's memory at most."""

LARGE_TABLE_MEMORY_MIB = 768
"""Tables may take 256 MiB, and are copied when they become the arrays of a scene."""

IMAGE_MEMORY_MIB = 1024
"""Images of up to 100 million pixels are read."""


@dataclass(frozen=True)
class FuzzTarget:
    """A reader and what is fed to it.

    Attributes:
        format: the format that findings are counted under.
        reader: name of the reader.
        file: name of the file that is damaged, in the target's folder.
        prepare: writes the other files that the reader needs, and gives valid contents of ``file``.
        read: reads the folder's file by the product's reader; raises ``WrongReadError`` for an impossible value.
        damages: drawn with equal chances.
        share: how many of all inputs it gets, in proportion to those of other targets.
        memory_mib: bound of what one input may add to the process's memory.
        starts_process: whether the reader works in a process of its own.
    """

    format: str
    reader: str
    file: str
    prepare: Callable[[Path], list[bytes]]
    read: Callable[[Path], object]
    damages: Sequence[Mutation]
    share: int = 10
    memory_mib: int = MEMORY_MIB
    starts_process: bool = False


class WrongReadError(Exception):
    """A reader returned what no valid file can hold."""


def require_sound(condition: object, expected: str) -> None:
    """Raises ``WrongReadError`` unless a condition holds."""
    if not condition:
        raise WrongReadError(expected)


def give_samples(*contents: bytes) -> Callable[[Path], list[bytes]]:
    """Makes a ``prepare`` that needs no other files."""
    return lambda folder: list(contents)
