"""The path, the reliable range and the cameras of a viewer as lines and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flows.simulation.stored_ranges import SideRange
from flows.viewer.path_drawing import ABOVE_GROUND_M, PathDrawing, collect_images, draw_path, measure_fov
from genre_tasks.config import IngestConfig
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Lens
from genre_tasks.stages.ingest import ingest


def straight(length_m: float, count: int) -> PathDrawing:
    points = np.stack([np.linspace(0, length_m, count), np.zeros(count), np.zeros(count)], 1)
    return PathDrawing(points, np.tile([0.0, 1.0, 0.0], (count, 1)))


def test_the_range_is_bounded_on_both_sides_and_closed_at_both_ends() -> None:
    segments = straight(10.0, 21).range_segments(SideRange(left_m=2.0, right_m=0.5))
    across = segments[segments[:, 0, 0] == segments[:, 1, 0]]
    along = segments[segments[:, 0, 0] != segments[:, 1, 0]]
    assert len(along) == 2 * 20
    assert set(along[..., 1].ravel().tolist()) == {2.0, -0.5}
    assert sorted(across[:, 0, 0].tolist()) == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert np.array_equal(across[..., 1], np.tile([2.0, -0.5], (6, 1)).astype(np.float32))


@pytest.mark.parametrize("count", [1, 2])
def test_a_short_path_can_be_drawn(count: int) -> None:
    drawing = straight(0.0, count)
    assert drawing.segments().shape == (count - 1, 2, 3)
    assert len(drawing.range_segments(SideRange(1.0, 1.0))) >= 1


def test_the_path_lies_on_the_ground() -> None:
    log = "synthetic:street?seed=900&frames=6&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300&samples=1"
    chunk = ingest(IngestConfig(width_px=64, height_px=36, chunk_frames=6), open_log(log), 0)
    drawing = draw_path(chunk)
    ego = chunk.chunk_SE3_ego
    assert np.allclose(drawing.points[:, :2], ego[:, :2, 3])
    points = chunk.static.positions
    for place in drawing.points:
        near = points[np.linalg.norm(points[:, :2] - place[:2], axis=1) < 6.0, 2]
        assert place[2] - ABOVE_GROUND_M == pytest.approx(np.percentile(near, 10), abs=0.1)
    assert np.allclose(np.einsum("fi,fi->f", drawing.left, ego[:, :3, 0]), 0, atol=0.05)
    assert np.allclose(np.linalg.norm(drawing.left, axis=1), 1)


def test_images_are_taken_where_there_are_some() -> None:
    log = "synthetic:street?seed=900&frames=6&cameras=1&width=64&height=36&lidar_beams=32&lidar_azimuths=300&samples=1"
    chunk = ingest(IngestConfig(width_px=64, height_px=36, chunk_frames=6), open_log(log), 0)
    # Evenly spread over all frames, the rows up to here are even ones.
    views = tuple(replace(view, frame=2 * view.frame + 1) for view in chunk.views)
    sparse = replace(chunk, frames=tuple(range(40)), views=views)
    assert [image.frame for image in collect_images(sparse)] == [1, 3, 5, 7, 9, 11]
    assert collect_images(replace(sparse, views=())) == ()


def test_the_field_of_view_is_the_lens_s() -> None:
    fov_rad, aspect = measure_fov(Lens(fx_px=100.0, fy_px=50.0, cx_px=80.0, cy_px=45.0, width_px=160, height_px=90))
    assert np.tan(fov_rad / 2) == pytest.approx(0.9)
    assert np.tan(fov_rad / 2) * aspect == pytest.approx(0.8)
