"""The rectangle of a box in an image, also where the camera plane cuts the box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Lens
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Actor, Points
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.projection import NEAR_M

LENS = Lens(160.0, 160.0, 160.0, 90.0, 320, 180)
NO_POINTS = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))


def _rectangle(pose: np.ndarray, size_m: tuple[float, float, float], lens: Lens = LENS) -> list[int]:
    actor = Actor("1", "Car", size_m, np.array([0]), pose[None], NO_POINTS)
    first, end = project_box(actor, NovelView("front", 0, 0.0, np.eye(4), lens, ("front", 0)))
    return [*first.tolist(), *end.tolist()]


def _sampled_rectangle(pose: np.ndarray, size_m: tuple[float, float, float], lens: Lens = LENS) -> np.ndarray:
    """The same by points all over the box's faces."""
    side = np.linspace(-0.5, 0.5, 121)
    cube = np.stack(np.meshgrid(side, side, [-0.5, 0.5], indexing="ij"), -1).reshape(-1, 3)
    faces = np.concatenate([np.roll(cube, k, 1) for k in range(3)]) * size_m
    points = faces @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] >= NEAR_M]
    rays = np.stack(distort(*(points[:, :2] / points[:, 2:]).T, lens.coefficients), 1)
    pixels = rays * LENS.fx_px + (LENS.cx_px, LENS.cy_px)
    pixels = pixels.clip(0, (LENS.width_px, LENS.height_px))
    return np.concatenate([pixels.min(0), pixels.max(0)])


@pytest.mark.parametrize("yaw_deg", [0, 10, 35])
@pytest.mark.parametrize("ahead_m", [-1.0, 0.0, 3.0, 20.0])
def test_a_box_next_to_the_camera_is_cut_at_the_camera_plane(yaw_deg: float, ahead_m: float) -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    pose[:3, 3] = (1.5, 0.8, ahead_m)
    size_m = (1.9, 1.6, 4.5)
    # The samples miss the box's very edges.
    assert np.allclose(_rectangle(pose, size_m), _sampled_rectangle(pose, size_m), atol=6)


@pytest.mark.parametrize("right_m", [-12.0, -9.0, 0.0, 6.0, 9.0, 12.0])
def test_a_distorting_lens_moves_the_rectangle(right_m: float) -> None:
    lens = replace(LENS, distortion=(-0.25, 0.04))
    pose = np.eye(4)
    pose[:3, 3] = (right_m, 0.8, 10.0)
    size_m = (1.9, 1.6, 4.5)
    found = _rectangle(pose, size_m, lens)
    assert np.allclose(found, _sampled_rectangle(pose, size_m, lens), atol=2)
    # A car at the border of the image is where the lens shows it, and not cut off.
    if abs(right_m) >= 9:
        assert np.abs(np.array(found) - _rectangle(pose, size_m)).max() > 10


def test_a_box_beyond_the_fold_of_a_lens_is_nowhere() -> None:
    pose = np.eye(4)
    pose[:3, 3] = (40.0, 0.0, 5.0)
    assert _rectangle(pose, (1.9, 1.6, 4.5), replace(LENS, distortion=(-0.25,))) == [0, 0, 0, 0]


def test_a_box_behind_the_camera_is_nowhere() -> None:
    pose = np.eye(4)
    pose[2, 3] = -5.0
    assert _rectangle(pose, (1.9, 1.6, 4.5)) == [0, 0, 0, 0]
