"""What is to be known of a driving log before it is trusted: findings, with their numbers and what to do about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

Severity = Literal["fatal", "warning", "note"]
# A log with a hole in every second frame would fill the screen.
_MAX_RUNS_LISTED = 8


@dataclass(frozen=True)
class Finding:
    """One thing to know about a log.

    Attributes:
        word: what it is, one word with underscores that programs can select by, such as ``odd_principal_point``.
        severity: ``fatal`` (the log cannot be reconstructed), ``warning`` (the result will be worse) or ``note``.
        message: what was found, without a full stop.
        remedy: what the user can do about it; may be empty.
        numbers: what was measured and what it was compared with, by name with the unit, such as ``offset_px``.
        camera: the camera that it is about; ``None`` for the log as a unit.
        frames: the frames that it is about; empty where it is about none in particular.

    >>> finding = Finding("far_jump", "warning", "the path jumps", numbers={"jump_m": 60.0}, frames=(3,))
    >>> finding.numbers["jump_m"]
    60.0
    """

    word: str
    severity: Severity
    message: str
    remedy: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    camera: str | None = None
    frames: tuple[int, ...] = ()


# Apart from ``DrivingLog``, since most readers leave nothing out.
@runtime_checkable
class ReportsFindings(Protocol):
    """A log whose reader leaves things out or meets what it does not read, such as images under another name."""

    def findings(self) -> tuple[Finding, ...]:
        """What the reader left out or could not use so far, in the order in which it was met.

        Returns:
            One entry per thing; sweeps count from when they were read.
        """
        ...


def format_frames(frames: Iterable[int]) -> str:
    """Lists frames for a message, with runs of neighbours shortened.

    Args:
        frames: increasing frame numbers.

    Returns:
        The frames, at most eight runs of them.

    >>> format_frames([3, 28, 29, 30])
    '3, 28–30'
    """
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = int(frame)
        else:
            runs.append([int(frame), int(frame)])
    texts = [str(first) if first == last else f"{first}–{last}" for first, last in runs]
    suffix = ", …" if len(texts) > _MAX_RUNS_LISTED else ""
    return ", ".join(texts[:_MAX_RUNS_LISTED]) + suffix
