"""Casts single rays through Gaussians: where a LiDAR's beam, which no image's pixel follows, meets a surface.

A Gaussian answers where its density is largest along the ray, which for a flat one is where the ray meets its disc. So
a road seen at a grazing angle is as exact as its discs are. The images' renderer has one depth a Gaussian, and one pose
an image; here a ray has an origin of its own, as a sensor that moves while it turns needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.lidar_simulation.ray_pairs import find_ray_pairs
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.render.constants import ALPHA_MAX, ALPHA_MIN
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.rotations import quats_to_matrices_numpy

EXTENT_SIGMAS = 3.33
"""Standard deviations to which a Gaussian is looked at: at full opacity its alpha falls below ``ALPHA_MIN`` there."""

_PAIRS_IN_MEMORY = 2_000_000


@dataclass(frozen=True)
class Rays:
    """N rays of one moment of the log.

    Attributes:
        origins: [N, 3] float64 metres, chunk coordinates.
        directions: [N, 3] float64 unit vectors, chunk axes.
    """

    origins: Float64
    directions: Float64

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class RayHits:
    """What N rays meet.

    Attributes:
        range_m: [N] where the surface is at which half of the blocked light is blocked; NaN where too little is.
        mean_range_m: [N] blended over all that the ray passes, as an image's depth is; NaN where nothing is.
        alpha: [N] in [0, 1].
        color: [N, 3] sRGB of the surface at ``range_m``; NaN where there is none.
        cosine: [N] between ray and the surface's normal, in [0, 1]; NaN where there is none.
        node: [N] int64 node of the scene graph that contributes most; -1 where there is no surface.
    """

    range_m: Float64
    mean_range_m: Float64
    alpha: Float64
    color: Float64
    cosine: Float64
    node: NDArray[np.int64]


@dataclass(frozen=True)
class CastSettings:
    """How rays are cast.

    Attributes:
        min_alpha: a ray that less of its light is blocked on meets no surface.
        surface_depth_m: what lies so near to the median surface along the ray is averaged with it.
        surface_depth_fraction: the same as a fraction of the range; the larger of the two counts.
    """

    min_alpha: float = 0.5
    surface_depth_m: float = 0.2
    surface_depth_fraction: float = 0.005


DEFAULT_CAST = CastSettings()


@dataclass(frozen=True)
class Discs:
    """M Gaussians by what a ray needs of them.

    Attributes:
        means: [M, 3] metres, chunk coordinates.
        whitening: [M, 3, 3] takes chunk axes to standard deviations of the Gaussian.
        normals: [M, 3] along the shortest axis.
        scales: [M, 3] standard deviations, metres.
        axes: [M, 3, 3] columns.
        opacities: [M].
        colors: [M, 3] sRGB.
        nodes: [M] of the scene graph.
    """

    means: Float64
    whitening: Float32
    normals: Float32
    scales: Float64
    axes: Float64
    opacities: Float32
    colors: Float32
    nodes: NDArray[np.int64]

    def select(self, rows: NDArray[np.int64]) -> Discs:
        """Copies some of the Gaussians."""
        return Discs(**{name: values[rows] for name, values in vars(self).items()})


def prepare_discs(
    splats: Splats, nodes: NDArray[np.int64], center: Float64, *, widening: float = 1.0, beam_rad: float = 0.0005
) -> Discs:
    """Prepares Gaussians for rays.

    Args:
        splats: of one moment, chunk coordinates.
        nodes: [M] the node of each.
        center: [3] about where the rays begin.
        widening: factor on scales within the disc's plane.
        beam_rad: standard deviation of a beam's width, by which discs are widened in their planes.

    Returns:
        The Gaussians that are opaque enough to matter.
    """
    rows = np.flatnonzero(splats.opacities.numpy() >= ALPHA_MIN)
    means = splats.means.numpy().astype(np.float64)[rows]
    scales = splats.scales.numpy().astype(np.float64)[rows]
    quats = splats.quats.numpy().astype(np.float64)[rows]
    axes = quats_to_matrices_numpy(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    shortest = scales.argmin(1)
    every = np.arange(len(rows))
    beam = beam_rad * np.linalg.norm(means - center, axis=1)
    widened = np.hypot(widening * scales, beam[:, None])
    # The thickness stays: a thicker disc would answer before the ray meets its plane.
    widened[every, shortest] = scales[every, shortest]
    return Discs(
        means=means,
        whitening=(np.swapaxes(axes, 1, 2) / widened[:, :, None]).astype(np.float32),
        normals=axes[every, :, shortest].astype(np.float32),
        scales=widened,
        axes=axes,
        opacities=splats.opacities.numpy()[rows],
        colors=splats.colors.numpy()[rows],
        nodes=nodes[rows],
    )


def select_discs_in_sector(discs: Discs, rays: Rays) -> Discs:
    """Leaves out Gaussians that lie in directions in which no ray goes, by azimuth.

    Args:
        discs: all.
        rays: of one part of a turn.

    Returns:
        Those that a ray may meet.
    """
    if not len(rays):
        return discs
    azimuth = np.arctan2(rays.directions[:, 1], rays.directions[:, 0])
    middle = np.angle(np.exp(1j * azimuth).mean())
    half = np.abs(_wrap(azimuth - middle)).max()
    offset = discs.means - rays.origins.mean(0)
    spread = np.linalg.norm(rays.origins - rays.origins.mean(0), axis=1).max()
    reach = EXTENT_SIGMAS * discs.scales.max(1) + spread
    flat = np.hypot(offset[:, 0], offset[:, 1])
    widest = np.arcsin(np.minimum(reach / flat.clip(1e-6), 1.0))
    apart = np.abs(_wrap(np.arctan2(offset[:, 1], offset[:, 0]) - middle))
    return discs.select(np.flatnonzero((apart <= half + widest) | (flat <= reach)))


def _wrap(angle: Float64) -> Float64:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def cast_rays(discs: Discs, rays: Rays, settings: CastSettings = DEFAULT_CAST) -> RayHits:
    """Casts rays through Gaussians.

    Args:
        discs: as they are at the rays' moment.
        rays: N of them; origins lie close together, as those of one part of a sweep.
        settings: what counts as a surface.

    Returns:
        What they meet.
    """
    if not len(rays):
        empty = np.zeros(0)
        return RayHits(empty, empty, empty, np.zeros((0, 3)), empty, np.zeros(0, np.int64))
    ray, disc, range_m, alpha = _collect_responses(discs, rays)
    order = np.lexsort((range_m, ray))
    return _blend(discs, rays, ray[order], disc[order], range_m[order].astype(np.float64), alpha[order], settings)


def _collect_responses(discs: Discs, rays: Rays) -> tuple[NDArray[np.int64], NDArray[np.int64], Float32, Float32]:
    """Pairs of ray and disc that matter: ray, disc, range and alpha, [K] each."""
    parts: list[tuple[NDArray[np.int64], NDArray[np.int64], Float32, Float32]] = []
    for ray, disc in find_ray_pairs(
        discs.means, EXTENT_SIGMAS * discs.scales, discs.axes, rays.origins, rays.directions, _PAIRS_IN_MEMORY
    ):
        # Subtracted in float64, then small enough for float32.
        offset = (rays.origins[ray] - discs.means[disc]).astype(np.float32)
        whitening = discs.whitening[disc]
        start = np.einsum("kij,kj->ki", whitening, offset)
        step = np.einsum("kij,kj->ki", whitening, rays.directions[ray].astype(np.float32))
        range_m = -(start * step).sum(1) / (step * step).sum(1)
        nearest = start + range_m[:, None] * step
        alpha = np.minimum(discs.opacities[disc] * np.exp(-0.5 * (nearest**2).sum(1)), np.float32(ALPHA_MAX))
        matters = (alpha >= ALPHA_MIN) & (range_m > 0)
        parts.append((ray[matters], disc[matters], range_m[matters], alpha[matters]))
    if not parts:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros(0, np.float32), np.zeros(0, np.float32)
    rays_found, discs_found, ranges, alphas = (np.concatenate(column) for column in zip(*parts, strict=True))
    return rays_found, discs_found, ranges, alphas


def _blend(
    discs: Discs,
    rays: Rays,
    ray: NDArray[np.int64],
    disc: NDArray[np.int64],
    range_m: Float64,
    alpha: Float32,
    settings: CastSettings,
) -> RayHits:
    """Blends pairs, sorted by ray and range, front to back."""
    count = len(rays)
    begin = np.searchsorted(ray, np.arange(count))
    passed = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha.astype(np.float64)))])
    before = np.exp(passed[:-1] - passed[begin][ray])
    after = np.exp(passed[1:] - passed[begin][ray])
    weight = before * alpha
    total = np.bincount(ray, weight, count)
    with np.errstate(invalid="ignore"):
        mean_range = np.bincount(ray, weight * range_m, count) / np.where(total > 0, total, np.nan)
    blocked = 1 - np.exp(passed[np.append(begin[1:], len(passed) - 1)] - passed[begin])
    # The pair at which half of what is blocked has been blocked.
    half = 1 - 0.5 * blocked[ray]
    crossing = np.flatnonzero((after <= half) & (before > half) & (blocked[ray] >= settings.min_alpha))
    median = np.full(count, np.nan)
    median[ray[crossing]] = range_m[crossing]
    reach = np.maximum(settings.surface_depth_m, settings.surface_depth_fraction * median)
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero(np.abs(range_m - median[ray]) <= reach[ray])
    ray, disc, weight, range_m = ray[near], disc[near], weight[near], range_m[near]
    total_near = np.bincount(ray, weight, count)
    divisor = np.where(total_near > 0, total_near, np.nan)

    def average(values: Float64) -> Float64:
        return np.asarray(np.bincount(ray, weight * values, count) / divisor)

    slant = np.abs((discs.normals[disc] * rays.directions[ray]).sum(1)).astype(np.float64)
    node = np.full(count, -1, np.int64)
    heaviest = np.lexsort((weight, ray))
    node[ray[heaviest]] = discs.nodes[disc[heaviest]]
    return RayHits(
        range_m=average(range_m),
        mean_range_m=mean_range,
        alpha=blocked,
        color=np.stack([average(discs.colors[disc, k].astype(np.float64)) for k in range(3)], 1),
        cosine=average(slant),
        node=node,
    )
