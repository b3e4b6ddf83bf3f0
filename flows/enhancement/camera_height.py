"""How high cameras are above the ground, in units of their poses: what the scale of a scene can be assumed from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from genre_tasks.errors import InputError

if TYPE_CHECKING:
    from genre_tasks.logs.posed_images.image_log import PosedImagesLog

_FRAMES = 16
_SIDE_PX = 48
_MIN_ALPHA = 0.5
_MIN_POINTS = 20
# Of what lies below a camera, points within 45° of straight down count.
_MAX_SLOPE = 1.0
_REMEDY = "Give --scale METRES_A_UNIT instead of auto."


def measure_height_over_scene(log: PosedImagesLog, scene_file: Path) -> float:
    """Measures how far below the path the surface of a scene lies.

    Args:
        log: with a scale of 1.
        scene_file: Gaussians in the coordinates of the poses.

    Returns:
        Units of the poses: the median over frames of what a camera that looks straight down sees.

    Raises:
        InputError: there is nothing below the path.
    """
    import torch
    from scipy.spatial.transform import Rotation

    from genre_tasks.config import FilePlacement
    from genre_tasks.logs.types import Lens
    from genre_tasks.render import render_views
    from genre_tasks.scene.novel_views import NovelView
    from genre_tasks.stages.scene_file import read_placed_scene

    x, y, z, w = Rotation.from_matrix(log.world_R_source).as_quat().tolist()
    centers = _select_centers(log)
    world_SE3_scene = np.eye(4)
    world_SE3_scene[:3, 3] = centers[len(centers) // 2]
    scene = read_placed_scene(str(scene_file), FilePlacement(quat=(w, x, y, z)), world_SE3_scene)
    lens = Lens(_SIDE_PX / 2, _SIDE_PX / 2, _SIDE_PX / 2, _SIDE_PX / 2, _SIDE_PX, _SIDE_PX)
    heights: list[float] = []
    for center in centers:
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = center - world_SE3_scene[:3, 3]
        view = NovelView("down", 0, 0.0, pose, lens, ("down", 0))
        with torch.no_grad():
            image = render_views(scene, [view])
        depth = image.expected_depth()[0][image.alpha[0] >= _MIN_ALPHA]
        if len(depth) >= _MIN_POINTS:
            heights.append(float(depth.median()))
    return _take_median(heights, scene_file)


def measure_height_over_points(log: PosedImagesLog, lidar_file: Path) -> float:
    """Measures how far below the path the points of a LiDAR lie.

    Args:
        log: with a scale of 1.
        lidar_file: PLY in the coordinates of the poses.

    Returns:
        Units of the poses.

    Raises:
        InputError: the file cannot be read, or there is nothing below the path.
    """
    from genre_tasks.scene.ply_reader import read_ply

    positions = read_ply(lidar_file)[0] @ log.world_R_source.T
    heights: list[float] = []
    for center in _select_centers(log):
        offset = positions - center
        depth = -offset[:, 2]
        below = depth[(depth > 0) & (np.hypot(offset[:, 0], offset[:, 1]) < _MAX_SLOPE * depth)]
        if len(below) >= _MIN_POINTS:
            heights.append(float(np.median(below)))
    return _take_median(heights, lidar_file)


def _select_centers(log: PosedImagesLog) -> np.ndarray:
    """[F, 3] positions of the vehicle, at some frames spread over the log."""
    count = min(_FRAMES, log.frame_count)
    frames = np.linspace(0, log.frame_count - 1, count).round().astype(int)
    return np.stack([log.world_SE3_lidar(int(frame))[:3, 3] for frame in frames])


def _take_median(heights: list[float], file: Path) -> float:
    if not heights:
        raise InputError("there is no ground below the cameras to take the scale from", remedy=_REMEDY, file=file)
    return float(np.median(heights))
