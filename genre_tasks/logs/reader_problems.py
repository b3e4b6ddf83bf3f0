"""What a reader of driving logs left out or repaired without failing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True)
class ReaderProblem:
    """Something that a reader left out or repaired without failing.

    Attributes:
        kind: a word to count by, such as ``invalid_box``.
        message: one sentence that names camera, frame or object.
    """

    kind: str
    message: str


# Apart from ``DrivingLog``, since most readers leave nothing out.
@runtime_checkable
class ReportsProblems(Protocol):
    """A log whose reader leaves things out, such as a box without a position or a camera without images."""

    def problems(self) -> tuple[ReaderProblem, ...]:
        """What the reader left out so far, in the order in which it was met.

        Returns:
            One entry per thing left out; sweeps count from when they were read.
        """
        ...
