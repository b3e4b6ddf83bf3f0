"""What is measured about a rollout: a row for each pose, and ``metrics.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flows.simulation.poses_table import PoseRow, pose_values
from flows.simulation.prepared_rollout import PreparedRollout
from flows.simulation.stored_ranges import SideRange
from genre_tasks.ego_paths.path_marks import PathMarks, mark_path
from genre_tasks.rollout.handover import Handover
from genre_tasks.rollout.render_rollout import RolloutImages
from storage.files import write_file
from storage.manifest import to_json_value

METRICS_FILE = "metrics.json"


class RowMaker:
    """Makes the rows of ``poses.parquet`` while poses are rendered.

    Args:
        rollout: that is rendered.
    """

    def __init__(self, rollout: PreparedRollout) -> None:
        self._path = rollout.checked.path
        self._marks = _mark_by_chunk(rollout)
        self._is_marked = bool(rollout.ranges)
        self._colliding = rollout.checked.colliding

    def make_row(self, images: RolloutImages) -> PoseRow:
        """Makes the row of a pose.

        Args:
            images: of the pose.
        """
        index = images.index
        marks = self._marks[images.chunk]
        names = self._colliding.get(index)
        return PoseRow(
            index=index,
            **pose_values(self._path, index),
            lateral_m=float(marks.lateral_m[index]),
            ahead_m=float(marks.ahead_m[index]),
            reliable=bool(marks.reliable[index]) if self._is_marked else None,
            outside_recording=bool(marks.outside_recording[index]),
            chunk=images.chunk,
            blended_chunk=images.blended_chunk,
            blend_weight=images.blend_weight,
            collision=", ".join(names) if names else None,
        )


def measure_rollout(rollout: PreparedRollout, rows: Sequence[PoseRow]) -> dict[str, Any]:
    """Sums a rollout up.

    Args:
        rollout: that was rendered.
        rows: one for each pose.

    Returns:
        JSON values: poses, cameras, maxima of the motion, violations, collisions, hand-overs and reliable ranges.
    """
    checked = rollout.checked
    return {
        "poses": len(rows),
        "seconds_of_driving": rows[-1].time_s - rows[0].time_s,
        "cameras": [camera.name for camera in rollout.rig],
        "images_per_s": 1 / rollout.pose_s,
        "maxima": checked.maxima,
        "violations": [str(violation) for violation in checked.violations],
        "collisions": [str(collision) for collision in checked.collisions],
        "max_lateral_m": max(abs(row.lateral_m) for row in rows),
        "reliable_fraction": sum(bool(row.reliable) for row in rows) / len(rows) if rollout.ranges else None,
        "outside_recording_fraction": sum(row.outside_recording for row in rows) / len(rows),
        "ranges": {
            str(number): {"left_m": side.left_m, "right_m": side.right_m} for number, side in rollout.ranges.items()
        },
        "handovers": [_describe_handover(handover) for handover in rollout.handovers],
    }


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Writes ``metrics.json``: no seconds are in it, so that equal rollouts have equal files.

    Args:
        folder: of the rollout.
        metrics: of :func:`measure_rollout`.
    """
    text = json.dumps(to_json_value(metrics), indent=1, ensure_ascii=False) + "\n"
    write_file(folder / METRICS_FILE, text.encode())


def _describe_handover(handover: Handover) -> dict[str, Any]:
    return {
        "before": handover.before,
        "after": handover.after,
        "border_frame": handover.border_frame,
        "start_frame": handover.start_frame,
        "end_frame": handover.end_frame,
        "seam_psnr_db": None if math.isnan(handover.psnr_db) else handover.psnr_db,
        "candidates": [{"frame": frame, "psnr_db": db} for frame, db in handover.candidates],
    }


def _mark_by_chunk(rollout: PreparedRollout) -> dict[int, PathMarks]:
    """Marks of all poses, as they are for the scene of each chunk."""
    checked = rollout.checked
    # Without any range the distances count alone.
    unlimited = SideRange(math.inf, math.inf)
    marks = {}
    for number in rollout.source.chunk_numbers:
        side = rollout.ranges.get(number, unlimited)
        marks[number] = mark_path(checked.path, checked.recorded, side.left_m, side.right_m)
    return marks
