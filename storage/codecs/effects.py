"""Plan of effects ↔ ``effects.parquet``, a row an effect, and what those that are on need to be applied.

That is ``gains.parquet``, ``shutters.parquet``, ``blurs.parquet``, ``own/CAMERA.png`` and, where there are any,
``points.parquet`` of multi-view stereo, ``poses.parquet``, refined, and ``ego_points.parquet``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from genre_tasks.effects.types import Decision, EffectParameters, EffectsPlan
from genre_tasks.logs.types import Float64, MotionBlur, RollingShutter
from storage.codecs.png import read_png, write_png
from storage.codecs.point_table import read_points, write_points
from storage.codecs.tables import (
    POSE,
    column,
    column_array,
    poses_from_rows,
    poses_to_column,
    read_records,
    read_rows,
    read_table,
    schema,
    write_records,
    write_table,
)
from storage.codecs.view_columns import CAMERA_AND_FRAME, image_columns

CameraMotion = TypeVar("CameraMotion", RollingShutter, MotionBlur)

_CHANNELS = ("red", "green", "blue")
_MOTION = ("velocity_x", "velocity_y", "velocity_z", "turn_x", "turn_y", "turn_z")


def _motion_schema(table: str, duration: str, note: str) -> pa.Schema:
    """A table of how cameras move while something lasts, which the column ``duration`` says in seconds."""
    return schema(
        table,
        [
            *CAMERA_AND_FRAME,
            column(duration, pa.float64(), note),
            column("frame_s", pa.float64(), "seconds to the next frame; 0: not stated"),
            *(column(n, pa.float64(), "of the camera in its own axes, m/s or rad/s") for n in _MOTION),
        ],
    )


EFFECTS = schema(
    "effects/1",
    [
        column("name", pa.string(), "the effect"),
        column("property", pa.string(), "what of the log decides"),
        column("value", pa.float64(), "in the unit; NaN where the log does not tell or nothing was measured"),
        column("unit", pa.string(), "of value and threshold"),
        column("threshold", pa.float64(), "called for above it; NaN where nothing was measured"),
        column("setting", pa.string(), "auto, on or off: what was configured"),
        column("choice", pa.string(), "on, off, or mark: told, not modelled"),
        column("reason", pa.string(), "why"),
        column("cost", pa.string(), "what enabling costs"),
    ],
)
GAINS = schema(
    "gains/1",
    [
        *CAMERA_AND_FRAME,
        *(column(c, pa.float64(), "natural logarithm of the image's gain in linear light") for c in _CHANNELS),
    ],
)
POSES = schema(
    "refined_poses/1",
    [*CAMERA_AND_FRAME, column("chunk_SE3_camera", POSE, "camera to chunk coordinates, 4 x 4 row by row, metres")],
)
EGO_POINTS = schema(
    "ego_points/1",
    [column("row", pa.int64(), "of the background's points: its colour is of the recording vehicle itself")],
)
SHUTTERS = _motion_schema("shutters/1", "readout_s", "seconds from the first row to the last")
BLURS = _motion_schema("blurs/1", "exposure_s", "seconds for which the shutter is open")


def write(folder: Path, value: EffectsPlan) -> None:
    """Writes the tables, and for each camera a picture that is white where the vehicle itself is in view.

    Args:
        folder: an empty folder.
        value: the plan.
    """
    # Tables without rows are written too: a missing one is damage, not a plan with fewer effects.
    write_records(folder / "effects.parquet", EFFECTS, value.decisions)
    # Without the reshape a plan without gains would be an array of no columns.
    gains = np.array(list(value.parameters.gains.values())).reshape(-1, 3)
    columns = image_columns(list(value.parameters.gains)) | {c: gains[:, k] for k, c in enumerate(_CHANNELS)}
    write_table(folder / "gains.parquet", GAINS, columns)
    _write_motions(folder / "shutters.parquet", SHUTTERS, value.parameters.shutters, "readout_s")
    _write_motions(folder / "blurs.parquet", BLURS, value.parameters.blurs, "exposure_s")
    if value.parameters.ego_masks:
        (folder / "own").mkdir()
    for camera, mask in value.parameters.ego_masks.items():
        # Three equal channels, because that is the one PNG format of the store, and any viewer shows it.
        write_png(folder / "own" / f"{camera}.png", np.repeat(np.uint8(255) * mask[..., None], 3, 2))
    if value.parameters.ego_points is not None:
        write_table(folder / "ego_points.parquet", EGO_POINTS, {"row": value.parameters.ego_points})
    # Only where there are any, as masks: plans without the effect keep their bytes.
    if value.parameters.stereo_points is not None:
        write_points(folder / "points.parquet", [(0, value.parameters.stereo_points)])
    poses = value.parameters.poses
    if poses:
        columns = image_columns(list(poses)) | {
            "chunk_SE3_camera": poses_to_column(np.stack(list(poses.values())), "refined poses")
        }
        write_table(folder / "poses.parquet", POSES, columns)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> EffectsPlan:
    """Reads a plan.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: not used: a plan is all payload.

    Returns:
        The plan, its decisions in their order.

    Raises:
        ArtifactCorruptError: a table or a picture is damaged.
    """
    rows = read_rows(folder / "gains.parquet", GAINS)
    gains = {(row["camera"], row["frame"]): (row["red"], row["green"], row["blue"]) for row in rows}
    # Sorted, because the order of a folder's files depends on the file system.
    masks = {path.stem: read_png(path)[..., 0] > 0 for path in sorted((folder / "own").glob("*.png"))}
    shutters = _read_motions(folder / "shutters.parquet", SHUTTERS, RollingShutter, "readout_s")
    blurs = _read_motions(folder / "blurs.parquet", BLURS, MotionBlur, "exposure_s")
    decisions = read_records(folder / "effects.parquet", EFFECTS, Decision)
    points_path = folder / "points.parquet"
    stereo_points = read_points(points_path).get(0) if points_path.is_file() else None
    poses = _read_poses(folder / "poses.parquet")
    ego_points = _read_ego_points(folder / "ego_points.parquet")
    parameters = EffectParameters(gains, masks, shutters, blurs, stereo_points, poses, ego_points)
    return EffectsPlan(decisions, parameters)


def measurements(value: EffectsPlan) -> dict[str, Any]:
    """Selects no measurements: all of a plan follows from the log.

    Returns:
        An empty dictionary.
    """
    return {}


def _read_ego_points(path: Path) -> NDArray[np.int64] | None:
    # A plan whose points show nothing of the vehicle has no such table.
    if not path.is_file():
        return None
    return column_array(read_table(path, EGO_POINTS)[0], "row")


def _read_poses(path: Path) -> dict[tuple[str, int], Float64]:
    # A plan whose poses are those of the log has no such table.
    if not path.is_file():
        return {}
    rows = read_rows(path, POSES)
    return {(row["camera"], row["frame"]): poses_from_rows(row["chunk_SE3_camera"])[0] for row in rows}


def _write_motions(
    path: Path,
    declared: pa.Schema,
    by_image: Mapping[tuple[str, int], RollingShutter] | Mapping[tuple[str, int], MotionBlur],
    duration: str,
) -> None:
    rows: list[RollingShutter | MotionBlur] = list(by_image.values())
    # The reshape gives an empty table its six columns too.
    velocities = np.array([[*row.velocity_m_s, *row.turn_rad_s] for row in rows]).reshape(-1, 6)
    columns = image_columns(list(by_image))
    columns |= {name: [getattr(row, name) for row in rows] for name in (duration, "frame_s")}
    columns |= {name: velocities[:, k] for k, name in enumerate(_MOTION)}
    write_table(path, declared, columns)


def _read_motions(
    path: Path, declared: pa.Schema, motion: Callable[..., CameraMotion], duration: str
) -> dict[tuple[str, int], CameraMotion]:
    by_image = {}
    for row in read_rows(path, declared):
        # Single columns and not lists, so that tools which only read flat tables can plot them.
        velocity = tuple(row[name] for name in _MOTION[:3])
        turn = tuple(row[name] for name in _MOTION[3:])
        by_image[row["camera"], row["frame"]] = motion(
            row[duration], velocity_m_s=velocity, turn_rad_s=turn, frame_s=row["frame_s"]
        )
    return by_image
