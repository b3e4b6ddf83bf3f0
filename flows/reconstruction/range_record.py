"""The reliable range of a run's scene in the run's folder, where the report finds it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from flows.reconstruction.run_summary import RangeSummary
from genre_tasks.errors import InputError

if TYPE_CHECKING:
    from genre_tasks.reliability.reliable_range import ReliableRange

FOLDER = "ranges"
"""Below the folder of a run."""


class _Point(BaseModel):
    shift_m: float
    estimate_db: float
    holds: bool


class _Record(BaseModel):
    stage: str
    left_m: float
    right_m: float
    farthest_m: float
    limit_db: float
    points: list[_Point]


def write_range_record(folder: Path, chunk: int, stage: str, reliable_range: ReliableRange) -> Path:
    """Writes a reliable range into a run's folder, over an earlier one of the same chunk.

    Args:
        folder: of the run.
        chunk: number of the chunk.
        stage: the stage that made the scene.
        reliable_range: the range and its curve.

    Returns:
        The file.

    Raises:
        OSError: the folder cannot be written.
    """
    from genre_tasks.atomic_path import write_atomically

    path = _find_path(folder, chunk)
    write_atomically(path, json.dumps(_describe(stage, reliable_range), indent=1).encode())
    return path


def read_range_record(folder: Path, chunk: int) -> RangeSummary | None:
    """Reads the reliable range that was last measured of a run's chunk.

    Args:
        folder: of the run.
        chunk: number of the chunk.

    Returns:
        The range, or ``None`` where it was not measured.

    Raises:
        InputError: the file is damaged.
    """
    path = _find_path(folder, chunk)
    try:
        record = _Record.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        raise InputError(
            "the record of a reliable range is damaged", remedy="Measure it again by `genre range`.", file=path
        ) from error
    return RangeSummary(
        stage=record.stage,
        left_m=record.left_m,
        right_m=record.right_m,
        farthest_m=record.farthest_m,
        limit_db=record.limit_db,
        points=tuple((p.shift_m, p.estimate_db, p.holds) for p in sorted(record.points, key=lambda p: p.shift_m)),
    )


def _find_path(folder: Path, chunk: int) -> Path:
    return folder / FOLDER / f"chunk-{chunk}-curve.json"


def _describe(stage: str, reliable_range: ReliableRange) -> dict[str, Any]:
    on_path = next(point for point in reliable_range.points if point.shift_m == 0)
    return {
        "stage": stage,
        "left_m": reliable_range.left_m,
        "right_m": reliable_range.right_m,
        "farthest_m": max(reliable_range.limits.shifts_m),
        "limit_db": on_path.estimate_db - reliable_range.limits.max_drop_db,
        "points": [
            {"shift_m": p.shift_m, "estimate_db": p.estimate_db, "holds": p.holds} for p in reliable_range.points
        ],
    }
