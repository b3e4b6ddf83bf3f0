"""Rays through Gaussians: exact on planes, front to back, and no Gaussian is overlooked."""

from __future__ import annotations

import numpy as np
import torch

from genre_tasks.lidar_simulation.ray_casting import (
    EXTENT_SIGMAS,
    CastSettings,
    Rays,
    cast_rays,
    prepare_discs,
    select_discs_in_sector,
)
from genre_tasks.lidar_simulation.ray_pairs import find_ray_pairs
from genre_tasks.scene.gaussians import Gaussians, Splats


def flat_discs(x_m: float, opacity: float, spacing: float = 0.5) -> Splats:
    """A wall at right angles to x, 6 m wide."""
    y, z = torch.meshgrid(torch.arange(-3, 3, spacing), torch.arange(-3, 3, spacing), indexing="ij")
    count = y.numel()
    means = torch.stack([torch.full((count,), x_m), y.reshape(-1), z.reshape(-1)], 1)
    scales = torch.tensor([0.01, 0.7 * spacing, 0.7 * spacing]).expand(count, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Splats(means, scales, quats, torch.full((count,), opacity), torch.full((count, 3), 0.25))


def join(*parts: Splats) -> Splats:
    return Splats(*(torch.cat(columns) for columns in zip(*(list(vars(p).values())[:5] for p in parts), strict=True)))


def cast(splats: Splats, directions: np.ndarray, nodes: np.ndarray | None = None, min_alpha: float = 0.5):
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rays = Rays(np.zeros_like(directions), directions)
    nodes = np.zeros(len(splats), np.int64) if nodes is None else nodes
    discs = prepare_discs(splats, nodes, np.zeros(3))
    return cast_rays(select_discs_in_sector(discs, rays), rays, CastSettings(min_alpha=min_alpha)), directions


def fan(count: int = 40) -> np.ndarray:
    random = np.random.default_rng(3)
    return np.concatenate([np.ones((count, 1)), random.uniform(-0.2, 0.2, (count, 2))], 1)


def test_ranges_are_those_of_the_plane():
    hits, directions = cast(flat_discs(8.0, 0.9), fan())
    assert np.abs(hits.range_m - 8.0 / directions[:, 0]).max() < 0.002
    assert np.abs(hits.cosine - directions[:, 0]).max() < 1e-5
    assert np.allclose(hits.color, 0.25)
    assert (hits.alpha > 0.9).all()


def test_a_road_at_a_grazing_angle_is_where_it_is():
    splats = flat_discs(0.0, 0.9)
    road = Splats(
        torch.stack([splats.means[:, 1] * 5 + 20, splats.means[:, 2], torch.full((len(splats),), -1.8)], 1),
        torch.tensor([2.0, 0.4, 0.01]).expand(len(splats), 3),
        splats.quats,
        splats.opacities,
        splats.colors,
    )
    down = np.radians(np.linspace(4, 8, 20))
    hits, directions = cast(road, np.stack([np.cos(down), np.zeros(20), -np.sin(down)], 1))
    assert np.abs(hits.range_m + 1.8 / directions[:, 2]).max() < 0.1


def test_an_opaque_wall_hides_what_is_behind_it_and_a_veil_does_not():
    nodes = np.repeat([0, 2], len(flat_discs(5.0, 0.9)))
    opaque, directions = cast(join(flat_discs(9.0, 0.95), flat_discs(5.0, 0.95)), fan(), nodes)
    assert np.abs(opaque.range_m - 5.0 / directions[:, 0]).max() < 0.01
    assert (opaque.node == 2).all()
    veiled, directions = cast(join(flat_discs(9.0, 0.95), flat_discs(5.0, 0.05)), fan(), nodes)
    assert np.abs(veiled.range_m - 9.0 / directions[:, 0]).max() < 0.02
    assert (veiled.node == 0).all()
    # The mean of both surfaces is on neither: it is what an image's depth would be.
    assert (veiled.mean_range_m < veiled.range_m - 0.05).all()


def test_nothing_and_too_little_have_no_range():
    away, _ = cast(flat_discs(8.0, 0.9), -fan())
    assert np.isnan(away.range_m).all() and (away.alpha == 0).all() and (away.node == -1).all()
    thin, _ = cast(flat_discs(8.0, 0.05), fan())
    assert np.isnan(thin.range_m).all() and (thin.alpha > 0).all()
    none, _ = cast(flat_discs(8.0, 0.9), np.zeros((0, 3)))
    assert len(none.range_m) == 0


def test_no_pair_that_matters_is_overlooked():
    random = torch.Generator().manual_seed(5)
    packed = torch.randn(300, 14, generator=random)
    packed[:, :3] *= 6
    packed[:, 3:6] = 0.5 * packed[:, 3:6] - 1
    splats = Gaussians.unpack(packed).activate()
    directions = np.random.default_rng(6).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.random.default_rng(7).normal(size=(400, 3)) * 0.3
    discs = prepare_discs(splats, np.zeros(300, np.int64), np.zeros(3))
    found = set()
    for ray, disc in find_ray_pairs(
        discs.means, EXTENT_SIGMAS * discs.scales, discs.axes, origins, directions, max_pairs=5000
    ):
        pairs = list(zip(ray.tolist(), disc.tolist(), strict=True))
        assert not found.intersection(pairs)
        found.update(pairs)
    start = np.einsum("mij,nmj->nmi", discs.whitening, origins[:, None] - discs.means)
    step = np.einsum("mij,nj->nmi", discs.whitening, directions)
    range_m = -(start * step).sum(-1) / (step**2).sum(-1)
    distance2 = ((start + range_m[..., None] * step) ** 2).sum(-1)
    matters = (discs.opacities * np.exp(-0.5 * distance2) >= 1 / 255) & (range_m > 0)
    assert matters.sum() > 500
    missed = set(zip(*(index.tolist() for index in np.nonzero(matters)), strict=True)) - found
    assert not missed
