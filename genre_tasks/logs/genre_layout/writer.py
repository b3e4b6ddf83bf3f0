"""Writes any driving log in the minimal layout, so that its reader gives the same log back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.genre_layout.box_table import write_boxes
from genre_tasks.logs.genre_layout.layout import BOXES_FILE, FORMAT, LENS_KEYS, LOG_FILE, VERSION
from genre_tasks.logs.genre_layout.sweep_files import write_sweep
from genre_tasks.logs.image_suffixes import find_image_suffix
from genre_tasks.logs.new_log_folder import new_log_folder
from genre_tasks.logs.types import Camera, DrivingLog
from genre_tasks.progress import Progress, silent


def write_genre_layout(log: DrivingLog, folder: Path, progress: Progress = silent) -> Path:
    """Writes a log. Images keep their bytes; what is missing stays missing.

    The folder appears complete or not at all. The same log gives the same bytes.

    Args:
        log: the log to write.
        folder: it does not exist yet, or is empty.
        progress: called once a frame.

    Returns:
        ``folder``.

    Raises:
        InputError: the folder holds something already; the log itself raises; an image is of another format; the name
            of a camera cannot be a folder's name.
        ResourceError: the disk is full or not writable.

    Example::

        write_genre_layout(open_log("kitti:2011_09_26/2011_09_26_drive_0009_sync"), Path("drive-9"))
        log = open_log("genre:drive-9")
    """
    require_camera_names((camera.name for camera in log.cameras), plain=True, log=log.uri, file=folder)
    with new_log_folder(folder, log.uri) as root:
        frames = []
        for frame in range(log.frame_count):
            frames.append(_write_frame(log, frame, root))
            progress(frame + 1, log.frame_count, f"frame {frame}")
        cameras = {camera.name: _describe_camera(camera) for camera in log.cameras}
        values = {"format": FORMAT, "version": VERSION, "cameras": cameras, "frames": frames}
        (root / LOG_FILE).write_text(json.dumps(values, indent=1), encoding="utf-8")
        if log.tracks():
            write_boxes(root / BOXES_FILE, log.tracks())
    return folder


def _write_frame(log: DrivingLog, frame: int, root: Path) -> dict[str, Any]:
    values: dict[str, Any] = {
        "time_s": log.frame_timestamp_s(frame),
        "lidar_pose": log.world_SE3_lidar(frame).tolist(),
    }
    # Missing keys stand for what is missing.
    sweep = log.sweep(frame)
    if sweep is not None:
        values["sweep"] = f"lidar/{frame:06d}.npz"
        if sweep.sensor_world is not None:
            values["lidar_position"] = sweep.sensor_world.tolist()
        (root / "lidar").mkdir(exist_ok=True)
        write_sweep(root / values["sweep"], sweep)
    values["images"] = {}
    for camera in log.cameras:
        entry: dict[str, Any] = {
            "time_s": log.camera_timestamp_s(camera.name, frame),
            "pose": log.world_SE3_camera(camera.name, frame).tolist(),
        }
        image = log.image_bytes(camera.name, frame)
        if image is not None:
            suffix = find_image_suffix(image, log=log.uri, camera=camera.name, frame=frame)
            entry["file"] = f"images/{camera.name}/{frame:06d}{suffix}"
            path = root / entry["file"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(image)
        values["images"][camera.name] = entry
    return values


def _describe_camera(camera: Camera) -> dict[str, Any]:
    values: dict[str, Any] = {key: getattr(camera.lens, key) for key in LENS_KEYS}
    if camera.lens.distortion:
        values["distortion"] = list(camera.lens.distortion)
    return {**values, "readout_s": camera.readout_s, "exposure_s": camera.exposure_s}
