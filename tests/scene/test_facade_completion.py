"""What goes on above the LiDAR's reach: façades grow as high as the images bear out, and nothing else does."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import pytest
from PIL import Image

from genre_tasks.logs.types import Lens
from genre_tasks.scene import facade_completion
from genre_tasks.scene.chunk import View
from genre_tasks.scene.facade_completion import LOWEST_TOP_M, SPACING_M, STEP_M, complete_facades
from tests.fakes import camera_turn

LENS = Lens(160.0, 160.0, 160.0, 120.0, 320, 240)
ROAD_M, WALL_M, BEHIND_M = -1.8, 8.0, 40.0
SWEPT_M = 3.0
"""Above the road: there the LiDAR's view ends."""
PATH = np.tile(np.eye(4), (5, 1, 1))
PATH[:, 0, 3] = 3.0 * np.arange(5)


def _texture(across: np.ndarray, up: np.ndarray, seed: int) -> np.ndarray:
    """Colours [..., 3] with structures of about a metre."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(1.5, 6.0, (8, 2)) * rng.choice((-1, 1), (8, 2))
    phases = across[..., None] * waves[:, 0] + up[..., None] * waves[:, 1]
    return 0.5 + 0.2 * np.stack([np.sin(phases + k).sum(-1) for k in rng.uniform(0, 6, (3, 8))], -1).clip(-2.4, 2.4)


def _sky(rays: np.ndarray, plain: bool) -> np.ndarray:
    up = rays[..., 2:] / np.linalg.norm(rays, axis=-1, keepdims=True)
    clouds = 0.0 if plain else 0.3 * np.sin(25 * rays[..., :1] / rays[..., 1:2].clip(0.1)) * np.sin(20 * up)
    return np.array([0.55, 0.7, 0.9]) + np.zeros_like(rays) + 0.1 * up + clouds


def _view(x: float, height: float, behind: float, plain_sky: bool) -> View:
    """Looks left from the path, at a façade of ``height`` over the road, one ``behind`` it, and the sky."""
    pose = np.eye(4)
    pose[:3, :3], pose[0, 3] = camera_turn(np.pi / 2), x
    u, v = np.meshgrid(np.arange(LENS.width_px) + 0.5, np.arange(LENS.height_px) + 0.5)
    rays = np.stack([(u - LENS.cx_px) / LENS.fx_px, (v - LENS.cy_px) / LENS.fy_px, np.ones_like(u)], -1)
    rays = rays @ pose[:3, :3].T
    image = _sky(rays, plain_sky)
    for seed, (distance, top) in enumerate(((BEHIND_M, behind), (WALL_M, height))):
        at = distance / rays[..., 1].clip(1e-3)
        across, up = x + at * rays[..., 0], at * rays[..., 2] - ROAD_M
        image = np.where((up < top)[..., None], _texture(across, up, seed), image)
    file = io.BytesIO()
    Image.fromarray((image.clip(0, 1) * 255).astype(np.uint8)).save(file, "PNG")
    return View("left", round(x), "source", 0.0, pose, LENS, file.getvalue())


def _views(height: float, behind: float = 0.0, plain_sky: bool = False) -> list[View]:
    return [_view(float(x), height, behind, plain_sky) for x in PATH[:, 0, 3]]


def _swept(height: float) -> np.ndarray:
    """A road, and the façade as far up as the LiDAR sees it."""
    x, y = np.meshgrid(np.arange(-10, 22, 0.2), np.arange(-8, 8, 0.2))
    road = np.stack([x.ravel(), y.ravel(), np.full(x.size, ROAD_M)], 1)
    x, z = np.meshgrid(np.arange(-4, 16, 0.1), np.arange(0, min(height, SWEPT_M), 0.1))
    return np.concatenate([road, np.stack([x.ravel(), np.full(x.size, WALL_M), ROAD_M + z.ravel()], 1)]).astype("f4")


def _heights(height: float, views: Sequence[View]) -> np.ndarray:
    """Above the road, of the points that were added over the part of the façade that several views see."""
    points = complete_facades(_swept(height), PATH, views)
    assert points.dtype == np.float32
    assert np.allclose(points[:, 1], WALL_M)
    seen = (points[:, 0] > 2) & (points[:, 0] < 10)
    return points[seen, 2] - ROAD_M


@pytest.mark.parametrize("plain_sky", [False, True])
@pytest.mark.parametrize("behind", [0.0, 14.0])
@pytest.mark.parametrize("height", [5.0, 7.0])
def test_a_facade_grows_to_its_height(height: float, behind: float, plain_sky: bool) -> None:
    heights = _heights(height, _views(height, behind, plain_sky))
    assert heights.min() > SWEPT_M - STEP_M
    tops = np.percentile(heights, 99)
    assert height - 2 * STEP_M < tops < height + 2 * STEP_M
    levels = np.unique(heights[heights < tops].round(3))
    assert np.diff(levels).max() < SPACING_M + 0.01, "without gaps"


@pytest.mark.parametrize("plain_sky", [False, True])
@pytest.mark.parametrize("behind", [0.0, 14.0])
def test_a_wall_that_ends_does_not_grow(behind: float, plain_sky: bool) -> None:
    heights = _heights(LOWEST_TOP_M + 0.3, _views(LOWEST_TOP_M + 0.3, behind, plain_sky))
    assert len(heights) == 0 or np.percentile(heights, 99) < LOWEST_TOP_M + 0.3 + 2 * STEP_M


def test_the_views_have_a_say() -> None:
    views = _views(7.0)
    assert len(complete_facades(_swept(7.0), PATH, views)) > 1000
    assert len(complete_facades(_swept(7.0), PATH, views[:1])) == 0, "one view cannot tell"
    assert len(complete_facades(_swept(7.0), PATH, [])) == 0
    assert len(complete_facades(_swept(LOWEST_TOP_M - 0.2), PATH, views)) == 0, "a fence is whole"
    far = _swept(7.0) + np.array([0, 60, 0], np.float32)
    assert len(complete_facades(far, PATH, views)) == 0, "out of reach"
    assert len(complete_facades(np.empty((0, 3), np.float32), PATH, views)) == 0


def test_the_order_of_the_points_does_not_matter() -> None:
    points, views = _swept(6.0), _views(6.0)
    shuffled = np.random.default_rng(0).permutation(points)
    a, b = (complete_facades(p, PATH, views) for p in (points, shuffled))
    assert np.allclose(np.sort(a, 0), np.sort(b, 0), atol=1e-4)
    assert np.array_equal(a, complete_facades(points, PATH, views))


def test_blocks_of_candidates_make_the_same_points(monkeypatch: pytest.MonkeyPatch) -> None:
    points, views = _swept(6.0), _views(6.0)
    whole = complete_facades(points, PATH, views)
    monkeypatch.setattr(facade_completion, "_BLOCK_VALUES", 100 * len(views))
    assert len(whole) and np.array_equal(whole, complete_facades(points, PATH, views))
