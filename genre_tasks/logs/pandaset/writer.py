"""Writes any driving log in the PandaSet layout, so that the PandaSet reader gives the same log back."""

from __future__ import annotations

import gzip
import json
import shutil
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError, ResourceError
from genre_tasks.logs.pandaset.layout import (
    BOX_HEADING,
    INTENSITY_SCALE,
    PANDA_R_OURS,
    PIXEL_CENTRE,
    SPINNING_SENSOR,
    frame_stem,
    pose_entry,
    quaternions,
    to_panda_axes,
)
from genre_tasks.logs.pandaset.pickle_writer import pickle_frame
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64, Sweep
from genre_tasks.progress import Progress, silent

_SIGNATURES = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n\x1a\n": ".png"}
_GZIP_LEVEL = 4  # coordinates are noise in their low bits: higher levels take three times as long for 2 %


def write_pandaset(log: DrivingLog, folder: Path, progress: Progress = silent) -> Path:
    """Writes ``log`` as the sequence folder ``folder`` (``…/002``) and returns it.

    Images keep their bytes (``.jpg``, or ``.png`` for a lossless log); what is missing stays missing. The folder
    appears whole or not at all. What PandaSet does not state (distortion, readout, a box's tilt) has
    fields of its own.

    Raises:
        InputError: the folder holds something already; the log itself raises; an image is neither JPEG nor PNG.
        ResourceError: the disk is full or not writable.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        remedy = "Give a folder that does not exist yet, or remove this one first."
        raise InputError("the folder to write holds something already", remedy=remedy, file=folder, log=log.uri)
    partial = folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}.partial"
    try:
        partial.mkdir(parents=True)
        _write_cameras(log, partial, progress)
        _write_lidar(log, partial, progress)
        _write_cuboids(log, partial)
        if folder.exists():
            folder.rmdir()
        partial.replace(folder)
    except OSError as error:
        problem = f"the sequence could not be written ({error})"
        raise ResourceError(problem, remedy="Free space, or give another folder.", file=folder, log=log.uri) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def _steps(log: DrivingLog) -> int:
    return log.frame_count * (len(log.cameras) + 1)


def _write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")


def _write_frame(path: Path, columns: dict[str, NDArray[Any]]) -> None:
    """Time 0 in the gzip header: the same log gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(pickle_frame(columns), _GZIP_LEVEL, mtime=0))


def _write_cameras(log: DrivingLog, root: Path, progress: Progress) -> None:
    frames = range(log.frame_count)
    for at, camera in enumerate(log.cameras):
        folder, name = root / "camera" / camera.name, camera.name
        _write_json(folder / "intrinsics.json", _intrinsics(camera))
        _write_json(folder / "poses.json", [pose_entry(log.world_SE3_camera(name, f)) for f in frames])
        _write_json(folder / "timestamps.json", [log.camera_timestamp_s(name, f) for f in frames])
        for frame in frames:
            image = log.image_bytes(name, frame)
            if image is not None:
                suffix = _suffix(image, log, name, frame)
                (folder / f"{frame_stem(frame)}{suffix}").write_bytes(image)
            progress(at * log.frame_count + frame + 1, _steps(log), f"{name} {frame}")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    lens = camera.lens
    given: dict[str, Any] = {"fx": lens.fx_px, "fy": lens.fy_px}
    given |= {
        "cx": lens.cx_px - PIXEL_CENTRE,
        "cy": lens.cy_px - PIXEL_CENTRE,
        "readout_s": camera.readout_s,
        "exposure_s": camera.exposure_s,
    }
    return given | ({"distortion": list(lens.distortion)} if lens.distortion else {})


def _suffix(image: bytes, log: DrivingLog, camera: str, frame: int) -> str:
    for signature, suffix in _SIGNATURES.items():
        if image.startswith(signature):
            return suffix
    remedy = "Encode the image as JPEG or PNG, or remove it: a missing image is survived."
    raise InputError("the image is neither JPEG nor PNG", remedy=remedy, log=log.uri, camera=camera, frame=frame)


def _write_lidar(log: DrivingLog, root: Path, progress: Progress) -> None:
    folder, frames = root / "lidar", range(log.frame_count)
    times = [log.frame_timestamp_s(f) for f in frames]
    _write_json(folder / "poses.json", [pose_entry(to_panda_axes(log.world_SE3_lidar(f))) for f in frames])
    _write_json(folder / "timestamps.json", times)
    _write_json(root / "meta" / "timestamps.json", times)
    for frame in frames:
        sweep = log.sweep(frame)
        if sweep is not None:
            _write_frame(folder / f"{frame_stem(frame)}.pkl.gz", _sweep_columns(sweep))
        progress(len(log.cameras) * log.frame_count + frame + 1, _steps(log), f"sweep {frame}")


def _sweep_columns(sweep: Sweep) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {name: sweep.points_world[:, k].copy() for k, name in enumerate("xyz")}
    columns["i"] = sweep.intensity.astype(np.float64) * INTENSITY_SCALE
    columns["t"] = sweep.timestamps_s.astype(np.float64)
    columns["d"] = np.full(len(sweep.points_world), SPINNING_SENSOR, dtype=np.int64)
    return columns


def _write_cuboids(log: DrivingLog, root: Path) -> None:
    tracks = log.tracks()
    turns = {track.track_id: track.world_SE3_box[:, :3, :3] @ PANDA_R_OURS.T for track in tracks}
    for frame in range(log.frame_count):
        rows = [(t, int(np.flatnonzero(t.frames == frame)[0])) for t in tracks if frame in t.frames]
        rotation = np.array([turns[t.track_id][k] for t, k in rows], dtype=np.float64).reshape(-1, 3, 3)
        path = root / "annotations/cuboids" / f"{frame_stem(frame)}.pkl.gz"
        _write_frame(path, _cuboid_columns(rows, rotation))


def _cuboid_columns(rows: list[tuple[CuboidTrack, int]], rotation: Float64) -> dict[str, NDArray[Any]]:
    """The columns of PandaSet's own files; ``sensor_id`` −1: seen by one sensor only, no sibling."""
    tracks = [track for track, _ in rows]
    centres = np.array([t.world_SE3_box[k, :3, 3] for t, k in rows], dtype=np.float64).reshape(-1, 3)
    sizes = np.array([t.size_m for t in tracks], dtype=np.float64).reshape(-1, 3)
    moving = np.array([t.moving for t in tracks], dtype=bool)
    columns: dict[str, NDArray[Any]] = {
        "uuid": np.array([t.track_id for t in tracks], dtype=object),
        "label": np.array([t.label for t in tracks], dtype=object),
        "yaw": np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        "stationary": ~moving,
        "camera_used": np.full(len(rows), -1, dtype=np.int64),
    }
    columns |= {f"position.{axis}": centres[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"dimensions.{axis}": sizes[:, k] for axis, k in (("x", 1), ("y", 0), ("z", 2))}
    columns["attributes.object_motion"] = np.array(["Moving" if m else "Parked" for m in moving], dtype=object)
    columns["cuboids.sibling_id"] = np.array(["-"] * len(rows), dtype=object)
    columns["cuboids.sensor_id"] = np.full(len(rows), -1, dtype=np.int64)
    if np.abs(rotation[:, 2, :2]).max(initial=0.0) > 0:
        columns |= dict(zip(BOX_HEADING, quaternions(rotation).T, strict=True))
    return columns
