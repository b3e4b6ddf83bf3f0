"""The LiDAR map has no gaps between the rings on an actor, stays within its outline, and leaves out stray returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from genre_tasks.config import InitialConfig
from genre_tasks.logs.types import Lens
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Points
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.initial_gaussians import fit_discs
from genre_tasks.scene.lidar_map import ACTOR_VOXEL_M, MAX_GAP_M, close_gaps, find_isolated

LENS = Lens(80.0, 80.0, 48.0, 32.0, 96, 64)


@dataclass(frozen=True)
class Ahead:
    frame: int = 0
    lens: Lens = LENS

    @property
    def chunk_SE3_camera(self) -> np.ndarray:
        return np.eye(4)


def _rings(gap_m: float, rings: int = 5) -> Points:
    """A car's side, 4 m long and 8 m ahead, met by horizontal rings a gap apart; x right, y down, z ahead."""
    x = np.arange(-2, 2, 0.03)
    y = (np.arange(rings) - (rings - 1) / 2) * gap_m
    positions = np.stack([np.tile(x, rings), np.repeat(y, len(x)), np.full(rings * len(x), 8.0)], 1)
    noise = np.random.default_rng(0).normal(0, 0.005, positions.shape)
    count = len(positions)
    return Points(
        (positions + noise).astype(np.float32),
        np.full((count, 3), 200, np.uint8),
        np.ones(count, bool),
        np.zeros(count, np.int16),
    )


def _discs(points: Points) -> Gaussians:
    return fit_discs(points, np.zeros(len(points)), 10_000, InitialConfig(opacity=0.95), ACTOR_VOXEL_M)


def _drawn(discs: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    out = render_surfaces(SceneGraph(discs, torch.zeros(len(discs), dtype=torch.int64), ()), [Ahead()])
    return out.alpha[0], out.expected_depth()[0]


def _rows(gap_m: float, rings: int = 5) -> slice:
    reach = LENS.fy_px * gap_m * (rings - 1) / 2 / 8
    return slice(int(LENS.cy_px - reach) + 2, int(LENS.cy_px + reach) - 1)


@pytest.mark.parametrize(("gap_m", "was", "least"), [(0.3, 0.7, 0.95), (0.4, 0.5, 0.88), (0.5, 0.4, 0.85)])
def test_gaps_between_rings_are_closed_at_their_surface(gap_m: float, was: float, least: float) -> None:
    discs, where = _discs(_rings(gap_m)), (_rows(gap_m), slice(34, 62))
    before = _drawn(discs)[0][where]
    alpha, depth = (image[where] for image in _drawn(close_gaps(discs)))
    assert float((before > 0.5).float().mean()) < was
    assert float((alpha > 0.5).float().mean()) >= least
    assert float((depth / 8 - 1)[alpha > 0.5].abs().quantile(0.9)) < 0.04


def test_the_outline_stays_and_what_is_farther_apart_is_left_open() -> None:
    alpha = _drawn(close_gaps(_discs(_rings(0.3))))[0]
    rows = _rows(0.3)
    assert float(alpha[: rows.start - 6].max()) < 0.3 and float(alpha[rows.stop + 6 :].max()) < 0.3
    apart = _discs(_rings(1.5 * MAX_GAP_M, rings=2))
    wide = [discs.log_scales.exp()[:, :2].median(0).values for discs in (close_gaps(apart), apart)]
    torch.testing.assert_close(*wide, rtol=0.1, atol=0)
    assert float(_drawn(close_gaps(apart))[0][32, 48]) < 0.1


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_points_are_left_as_they_are_or_finite(count: int) -> None:
    few = Gaussians.unpack(torch.zeros(count, 14))
    few = Gaussians(
        torch.randn(count, 3),
        few.log_scales,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        *few.pack()[:, 10:11].T,
        few.colors,
    )
    assert len(close_gaps(few)) == count and bool(close_gaps(few).pack().isfinite().all())


def test_points_at_one_place_stay_finite() -> None:
    here = _discs(_rings(0.0, rings=3))
    assert bool(close_gaps(here).pack().isfinite().all())


def test_returns_that_stand_alone_hide_nothing() -> None:
    rng = np.random.default_rng(0)
    road = np.stack([rng.uniform(-10, 10, 20_000), rng.uniform(-10, 10, 20_000), rng.normal(0, 0.01, 20_000)], 1)
    few = np.array([[0.0, 0.0, 6.0], [4.0, 2.0, 8.0], [4.1, 2.0, 8.0]])
    means = np.concatenate([road[::20], few])
    isolated = find_isolated(means, np.concatenate([road, few]), np.zeros(len(means), np.int64))
    assert isolated[-len(few) :].all() and not isolated[: -len(few)].any()


def test_a_sparse_recording_is_not_isolated() -> None:
    # Far away every return is metres from the next one, and so is each on all of a sparse log.
    near, far = (
        np.stack(np.meshgrid(*2 * [np.arange(0, 40 * gap, gap)], [0.0]), -1).reshape(-1, 3) for gap in (0.1, 4)
    )
    returns = np.concatenate([near, far + 200])
    octave = np.repeat([0, 4], [len(near), len(far)])
    assert not find_isolated(returns, returns, octave).any()
    assert not find_isolated(returns[:3], returns[:3], octave[:3]).any()
    # A simulated vehicle that stands repeats its returns exactly; what lies between them is not isolated for that.
    repeated = np.repeat(returns, 5, axis=0)
    means = np.concatenate([returns, returns[:1] + 1e-3])
    assert not find_isolated(means, repeated, np.zeros(len(means), np.int64)).any()
