"""Which boxes of a log can be used: one rule for all readers. A bad box is left out alone, and a finding names it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float64

# Below that, rounding alone would decide where a box points.
_MIN_QUATERNION_NORM = 1e-6
# No place on Earth is so far from another, and squares of such numbers are still finite.
_MAX_NUMBER = 1e9
_REMEDY = "Correct the box, or copy the file again; it is left out."
_REMEDY_FOR_ALL = "Correct the boxes, or copy the file again."


@dataclass(frozen=True)
class StatedBox:
    """A box as a file states it, for messages.

    Attributes:
        frame: log frame.
        track_id: of its object.
        label: class, in the file's words.
        source: name of the file, and what finds the box in it, such as ``labels.txt, line 7``.
        frames: all log frames that lack the box if it is left out; empty: ``frame`` alone.
    """

    frame: int
    track_id: str
    label: str
    source: str
    frames: tuple[int, ...] = ()


def find_bad_boxes(
    centres: Float64, sizes_m: Float64, quats: Float64 | None = None, angles_rad: Float64 | None = None
) -> dict[int, str]:
    """Finds boxes without a place, a size or a direction.

    Args:
        centres: [N, 3] metres.
        sizes_m: [N, 3] in any order.
        quats: [N, 4] orientations, where quaternions state them.
        angles_rad: [N, K] orientations, where angles state them.

    Returns:
        Row → what is wrong with its box, a clause that follows "the box"; without sound boxes.

    >>> find_bad_boxes(np.zeros((3, 3)), np.array([[4.0, 2.0, 1.5], [4.0, 0.0, 1.5], [4.0, 2.0, np.nan]]))
    {1: 'has a size that is not positive', 2: 'is not finite'}
    """
    parts = [part for part in (centres, sizes_m, quats, angles_rad) if part is not None]
    numbers = np.concatenate(parts, axis=1)
    is_finite = np.asarray(np.isfinite(numbers).all(axis=1))
    has_size = np.asarray((sizes_m > 0).all(axis=1))
    is_near = (np.abs(numbers) <= _MAX_NUMBER).all(axis=1)
    has_direction = np.ones(len(numbers), dtype=bool)
    if quats is not None:
        # The largest number stands for the length: its square would overflow for some that are bad anyway.
        has_direction = np.abs(quats).max(axis=1, initial=0.0) >= _MIN_QUATERNION_NORM
    problems = {}
    for row in np.flatnonzero(~(is_finite & has_size & is_near & has_direction)).tolist():
        if not is_finite[row]:
            problems[row] = "is not finite"
        elif not has_size[row]:
            problems[row] = "has a size that is not positive"
        elif not has_direction[row]:
            problems[row] = "has a quaternion of zeros"
        else:
            problems[row] = f"has a number beyond {_MAX_NUMBER:.0e}"
    return problems


def report_bad_boxes(
    problems: Mapping[int, str],
    count: int,
    locate: Callable[[int], StatedBox | None],
    *,
    file: Path,
    log: str,
) -> tuple[Finding, ...]:
    """Describes the boxes that are left out.

    Args:
        problems: of :func:`find_bad_boxes`.
        count: of all boxes.
        locate: row → where its box is stated; ``None`` for a box that no frame of the log needs.
        file: that states the boxes, for the error.
        log: URI of the log, for the error.

    Returns:
        ``invalid_box`` for each of them.

    Raises:
        InputError: all boxes are bad, which is no slip but a mistake in the file as a unit.
    """
    if problems and len(problems) == count:
        row, first = next(iter(problems.items()))
        box = locate(row)
        where = "" if box is None else f"(frame {box.frame}; {box.source}) "
        problem = f"all {count} boxes are bad: the first one {where}{first}"
        raise InputError(problem, remedy=_REMEDY_FOR_ALL, file=file, log=log)
    located = ((locate(row), problem) for row, problem in problems.items())
    return tuple(describe_bad_box(box, problem) for box, problem in located if box is not None)


def describe_bad_box(box: StatedBox, problem: str) -> Finding:
    """Describes a box that is left out.

    Args:
        box: the box.
        problem: a clause that follows "the box".

    Returns:
        ``invalid_box``.

    >>> describe_bad_box(StatedBox(3, "7", "Car", "labels.txt, line 9"), "is not finite").message
    'the box of Car 7 in frame 3 (labels.txt, line 9) is not finite'
    """
    message = f"the box of {box.label} {box.track_id} in frame {box.frame} ({box.source}) {problem}"
    return Finding("invalid_box", "warning", message, _REMEDY, frames=box.frames or (box.frame,))
