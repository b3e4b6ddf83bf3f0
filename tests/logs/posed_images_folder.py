"""A synthetic street as images with poses: transforms.json and COLMAP models, in any axes and unit."""

from __future__ import annotations

import functools
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog, Lens

STREET = "synthetic:street?seed=1000&frames=8&cameras=3&width=96&height=54&samples=1"
OPENGL_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class SourceAxes:
    """How a file of poses has the world: turned, and in units of so many metres."""

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    metres_per_unit: float = 1.0

    def pose(self, world_SE3_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ world_SE3_camera[:3, :3]
        pose[:3, 3] = self.rotation @ world_SE3_camera[:3, 3] / self.metres_per_unit
        return pose


Y_DOWN = SourceAxes(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), 2.5)
"""As COLMAP mostly has it: up is −y."""


def write_images(log: DrivingLog, folder: Path) -> None:
    """``images/CAMERA/FRAME.png``."""
    for camera in log.cameras:
        (folder / "images" / camera.name).mkdir(parents=True, exist_ok=True)
        for frame in range(log.frame_count):
            (folder / "images" / camera.name / f"{frame:04d}.png").write_bytes(_cast(log.uri, camera.name, frame))


@functools.cache
def _cast(street: str, camera: str, frame: int) -> bytes:
    """Ray-cast once for all tests of the process."""
    data = _open(street).image_bytes(camera, frame)
    assert data is not None
    return data


@functools.cache
def _open(street: str) -> DrivingLog:
    return open_log(street)


def list_frames(log: DrivingLog, axes: SourceAxes) -> list[dict[str, Any]]:
    frames = []
    for frame in range(log.frame_count):
        for camera in log.cameras:
            pose = axes.pose(log.world_SE3_camera(camera.name, frame)) @ OPENGL_FLIP
            lens = camera.lens
            frames.append(
                {
                    "file_path": f"./images/{camera.name}/{frame:04d}.png",
                    "transform_matrix": pose.tolist(),
                    "fl_x": lens.fx_px,
                    "fl_y": lens.fy_px,
                    "cx": lens.cx_px,
                    "cy": lens.cy_px,
                    "w": lens.width_px,
                    "h": lens.height_px,
                }
            )
    return frames


def write_transforms(folder: Path, axes: SourceAxes | None = None, street: str = STREET) -> Path:
    """A folder with transforms.json and its images."""
    log = _open(street)
    write_images(log, folder)
    values = {"camera_model": "OPENCV", "frames": list_frames(log, axes or SourceAxes())}
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder


def write_colmap(folder: Path, binary: bool, axes: SourceAxes = Y_DOWN, street: str = STREET) -> Path:
    """A folder with ``sparse/0`` and its images."""
    log = _open(street)
    write_images(log, folder)
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    rows = []
    for frame in range(log.frame_count):
        for number, camera in enumerate(log.cameras, 1):
            camera_SE3_source = np.linalg.inv(axes.pose(log.world_SE3_camera(camera.name, frame)))
            x, y, z, w = Rotation.from_matrix(camera_SE3_source[:3, :3]).as_quat()
            rows.append(((w, x, y, z), camera_SE3_source[:3, 3], number, f"{camera.name}/{frame:04d}.png"))
    lenses = [camera.lens for camera in log.cameras]
    if binary:
        (model / "cameras.bin").write_bytes(_binary_cameras(lenses))
        (model / "images.bin").write_bytes(_binary_images(rows))
    else:
        lines = [f"{n} PINHOLE {x.width_px} {x.height_px} {_intrinsics(x)}" for n, x in enumerate(lenses, 1)]
        (model / "cameras.txt").write_text("\n".join(["# cameras", *lines, ""]))
        lines = []
        for n, (quat, translation, camera, name) in enumerate(rows, 1):
            numbers = " ".join(repr(float(value)) for value in (*quat, *translation))
            # Points are listed for every other image, and the others have an empty line.
            lines += [f"{n} {numbers} {camera} {name}", "1.5 2.5 -1" if n % 2 else ""]
        (model / "images.txt").write_text("\n".join(["# images", *lines, ""]))
    return folder


def _intrinsics(lens: Lens) -> str:
    return f"{lens.fx_px!r} {lens.fy_px!r} {lens.cx_px!r} {lens.cy_px!r}"


def _binary_cameras(lenses: list[Lens]) -> bytes:
    data = struct.pack("<Q", len(lenses))
    for number, lens in enumerate(lenses, 1):
        data += struct.pack("<iiQQ", number, 1, lens.width_px, lens.height_px)
        data += struct.pack("<4d", lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    return data


def _binary_images(rows: list[tuple[Any, ...]]) -> bytes:
    data = struct.pack("<Q", len(rows))
    for number, (quat, translation, camera, name) in enumerate(rows, 1):
        data += struct.pack("<i7di", number, *quat, *translation, camera)
        data += name.encode() + b"\0"
        data += struct.pack("<Q", number % 3) + b"\0" * 24 * (number % 3)
    return data
