"""Writes any driving log in the PandaSet layout, so that the PandaSet reader gives the same log back."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.image_suffixes import find_image_suffix
from genre_tasks.logs.new_log_folder import new_log_folder
from genre_tasks.logs.pandaset.layout import (
    BOX_HEADING,
    INTENSITY_SCALE,
    PANDA_R_FLU,
    PIXEL_CENTRE,
    SPINNING_SENSOR,
    format_pose,
    frame_stem,
    matrices_to_quats,
    to_panda_axes,
)
from genre_tasks.logs.pandaset.pickle_writer import pickle_table
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64, Sweep
from genre_tasks.progress import Progress, silent

# Coordinates are noise in their low bits: higher levels take three times as long for 2 %.
_GZIP_LEVEL = 4
# Cuboids.sensor_id of a box that was annotated once, without a sibling.
_NO_SENSOR = -1


def write_pandaset(log: DrivingLog, folder: Path, progress: Progress = silent) -> Path:
    """Writes a log as a PandaSet sequence folder, for tools that read that layout or to keep a synthetic log.

    Images keep their bytes (``.jpg``, ``.png``, ``.webp``, ``.tif`` or ``.bmp``); what is missing stays missing. The
    folder appears complete or not at all. What PandaSet does not state (size of the images, distortion, readout, a
    box's tilt) has fields of its own. The same log gives the same bytes.

    Args:
        log: the log to write.
        folder: the sequence folder, such as ``…/002``; it does not exist yet, or is empty.
        progress: called once an image and once a sweep.

    Returns:
        ``folder``.

    Raises:
        InputError: the folder holds something already; the log itself raises; an image is of another format; the name
            of a camera cannot be a folder's name.
        ResourceError: the disk is full or not writable.

    Example::

        write_pandaset(open_log("synthetic:street?seed=7"), Path("sequences/007"))
        log = open_log("pandaset:sequences/007")
    """
    require_camera_names((camera.name for camera in log.cameras), log=log.uri, file=folder)
    with new_log_folder(folder, log.uri) as root:
        _write_cameras(log, root, progress)
        _write_lidar(log, root, progress)
        _write_cuboids(log, root)
    return folder


def _count_steps(log: DrivingLog) -> int:
    return log.frame_count * (len(log.cameras) + 1)


def _write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")


def _write_table(path: Path, columns: dict[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Time 0 in the gzip header: the same log gives the same bytes.
    path.write_bytes(gzip.compress(pickle_table(columns), _GZIP_LEVEL, mtime=0))


def _write_cameras(log: DrivingLog, root: Path, progress: Progress) -> None:
    frames = range(log.frame_count)
    for index, camera in enumerate(log.cameras):
        name = camera.name
        folder = root / "camera" / name
        _write_json(folder / "intrinsics.json", _format_intrinsics(camera))
        _write_json(folder / "poses.json", [format_pose(log.world_SE3_camera(name, frame)) for frame in frames])
        _write_json(folder / "timestamps.json", [log.camera_timestamp_s(name, frame) for frame in frames])
        for frame in frames:
            image = log.image_bytes(name, frame)
            if image is not None:
                suffix = find_image_suffix(image, log=log.uri, camera=name, frame=frame)
                (folder / f"{frame_stem(frame)}{suffix}").write_bytes(image)
            progress(index * log.frame_count + frame + 1, _count_steps(log), f"{name} {frame}")


def _format_intrinsics(camera: Camera) -> dict[str, Any]:
    lens = camera.lens
    intrinsics: dict[str, Any] = {
        "fx": lens.fx_px,
        "fy": lens.fy_px,
        "cx": lens.cx_px - PIXEL_CENTRE,
        "cy": lens.cy_px - PIXEL_CENTRE,
        # Which size the numbers above belong to: a reader would otherwise take that of most images.
        "width": lens.width_px,
        "height": lens.height_px,
        "readout_s": camera.readout_s,
        "exposure_s": camera.exposure_s,
    }
    if lens.distortion:
        intrinsics["distortion"] = list(lens.distortion)
    return intrinsics


def _write_lidar(log: DrivingLog, root: Path, progress: Progress) -> None:
    folder = root / "lidar"
    frames = range(log.frame_count)
    times = [log.frame_timestamp_s(frame) for frame in frames]
    poses = [format_pose(to_panda_axes(log.world_SE3_lidar(frame))) for frame in frames]
    _write_json(folder / "poses.json", poses)
    _write_json(folder / "timestamps.json", times)
    # PandaSet has the times twice, and other readers look for them here.
    _write_json(root / "meta" / "timestamps.json", times)
    for frame in frames:
        sweep = log.sweep(frame)
        if sweep is not None:
            _write_table(folder / f"{frame_stem(frame)}.pkl.gz", _sweep_columns(sweep))
        progress(len(log.cameras) * log.frame_count + frame + 1, _count_steps(log), f"sweep {frame}")


def _sweep_columns(sweep: Sweep) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {name: sweep.points_world[:, k].copy() for k, name in enumerate("xyz")}
    columns["i"] = sweep.intensity.astype(np.float64) * INTENSITY_SCALE
    columns["t"] = sweep.timestamps_s.astype(np.float64)
    columns["d"] = np.full(len(sweep.points_world), SPINNING_SENSOR, dtype=np.int64)
    return columns


def _write_cuboids(log: DrivingLog, root: Path) -> None:
    tracks = log.tracks()
    world_R_panda = {track.track_id: track.world_SE3_box[:, :3, :3] @ PANDA_R_FLU.T for track in tracks}
    for frame in range(log.frame_count):
        # (track, index of this frame in it) of every object annotated in this frame.
        rows = [(track, int(np.flatnonzero(track.frames == frame)[0])) for track in tracks if frame in track.frames]
        rotations = np.array([world_R_panda[track.track_id][k] for track, k in rows], dtype=np.float64)
        path = root / "annotations/cuboids" / f"{frame_stem(frame)}.pkl.gz"
        _write_table(path, _cuboid_columns(rows, rotations.reshape(-1, 3, 3)))


def _cuboid_columns(rows: list[tuple[CuboidTrack, int]], world_R_panda: Float64) -> dict[str, NDArray[Any]]:
    """The columns of PandaSet's own files, for boxes whose axes [N, 3, 3] are PandaSet's."""
    tracks = [track for track, _ in rows]
    centres = np.array([track.world_SE3_box[k, :3, 3] for track, k in rows], dtype=np.float64).reshape(-1, 3)
    sizes = np.array([track.size_m for track in tracks], dtype=np.float64).reshape(-1, 3)
    moving = np.array([track.moving for track in tracks], dtype=bool)
    columns: dict[str, NDArray[Any]] = {
        "uuid": np.array([track.track_id for track in tracks], dtype=object),
        "label": np.array([track.label for track in tracks], dtype=object),
        "yaw": np.arctan2(world_R_panda[:, 1, 0], world_R_panda[:, 0, 0]),
        "stationary": ~moving,
        "camera_used": np.full(len(rows), -1, dtype=np.int64),
    }
    columns |= {f"position.{axis}": centres[:, k] for k, axis in enumerate("xyz")}
    # PandaSet's x is the width and its y the length: the box's y is forward.
    columns |= {f"dimensions.{axis}": sizes[:, k] for axis, k in (("x", 1), ("y", 0), ("z", 2))}
    # PandaSet knows Moving, Stopped and Parked; a track only says whether it moves at all.
    columns["attributes.object_motion"] = np.array(["Moving" if m else "Parked" for m in moving], dtype=object)
    columns["cuboids.sibling_id"] = np.array(["-"] * len(rows), dtype=object)
    columns["cuboids.sensor_id"] = np.full(len(rows), _NO_SENSOR, dtype=np.int64)
    is_tilted = np.abs(world_R_panda[:, 2, :2]).max(initial=0.0) > 0
    if is_tilted:
        columns |= dict(zip(BOX_HEADING, matrices_to_quats(world_R_panda).T, strict=True))
    return columns
