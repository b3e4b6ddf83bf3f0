"""Finds which Gaussians may matter to which rays, by azimuth and elevation about the rays' common origin."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64

ROW_RAD = np.radians(0.25)
"""Height of a row of rays: within a row rays are sorted by azimuth, so that a Gaussian takes a range of them."""


def find_ray_pairs(
    means: Float64,
    extents: Float64,
    axes: Float64,
    origins: Float64,
    directions: Float64,
    max_pairs: int,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Finds pairs of a ray and a Gaussian whose bounds it crosses.

    Args:
        means: [M, 3] metres.
        extents: [M, 3] metres to which a Gaussian reaches along its axes.
        axes: [M, 3, 3] columns.
        origins: [N, 3] metres, close together.
        directions: [N, 3] unit vectors.
        max_pairs: about so many come at a time.

    Yields:
        Indices of rays and of Gaussians [K].
    """
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    row = _to_row(np.arcsin(directions[:, 2].clip(-1, 1)))
    # One key that sorts by row and then by azimuth: a range of azimuths in a row is a range of sorted rays.
    key = row * 8.0 + azimuth
    order = np.argsort(key)
    key = key[order]
    gaussian, center, half, low, high = _bound_gaussians(means, extents, axes, origins)
    low = np.maximum(_to_row(low), row.min())
    high = np.minimum(_to_row(high), row.max())
    row_count = (high - low + 1).clip(0)
    for part in _split(row_count, max_pairs):
        index = np.repeat(np.arange(len(row_count))[part], row_count[part])
        first = np.cumsum(row_count[part]) - row_count[part]
        at_row = low[index] + np.arange(len(index)) - np.repeat(first, row_count[part])
        begin = np.searchsorted(key, at_row * 8.0 + np.maximum(center[index] - half[index], -np.pi))
        end = np.searchsorted(key, at_row * 8.0 + np.minimum(center[index] + half[index], np.pi), side="right")
        for some in _split(end - begin, max_pairs):
            length = (end - begin)[some].clip(0)
            owner = np.repeat(gaussian[index[some]], length)
            ends = np.cumsum(length)
            position = np.arange(len(owner)) + np.repeat(begin[some] - (ends - length), length)
            yield order[position], owner


def _bound_gaussians(
    means: Float64, extents: Float64, axes: Float64, origins: Float64
) -> tuple[NDArray[np.int64], Float64, Float64, Float64, Float64]:
    """Index, azimuth, half width in azimuth, lowest and highest elevation; one that crosses ±π comes twice."""
    middle = origins.mean(0)
    offset = means - middle
    # Origins apart from the middle see a Gaussian elsewhere: its bounds grow by that.
    spread = np.linalg.norm(origins - middle, axis=1).max()
    flat = np.hypot(offset[:, 0], offset[:, 1]).clip(1e-6)
    outward = np.stack([offset[:, 0] / flat, offset[:, 1] / flat, np.zeros(len(flat))], 1)
    across = np.stack([-outward[:, 1], outward[:, 0], np.zeros(len(flat))], 1)
    # A box around the ellipsoid: outward, to the side, and upward.
    depth = _reach_along(outward, extents, axes) + spread
    sideways = _reach_along(across, extents, axes) + spread
    height = np.sqrt(((axes[:, 2] * extents) ** 2).sum(1)) + spread
    nearest = flat - depth
    surrounds = nearest <= 0
    half_azimuth = np.where(surrounds, np.pi, np.arctan2(sideways, nearest))
    farthest = np.hypot(flat + depth, sideways)
    low = offset[:, 2] - height
    high = offset[:, 2] + height
    # The nearest corner of the box is seen steepest, up as well as down.
    nearest = nearest.clip(0)
    lowest = np.arctan2(low, np.where(low < 0, nearest, farthest))
    highest = np.arctan2(high, np.where(high > 0, nearest, farthest))
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    index = np.arange(len(means))
    copies = [(index, azimuth + turn) for turn in (-2 * np.pi, 0.0, 2 * np.pi)]
    index = np.concatenate([i for i, _ in copies])
    center = np.concatenate([a for _, a in copies])
    half = half_azimuth[index]
    crosses = np.abs(center) - half <= np.pi
    index, center, half = index[crosses], center[crosses], half[crosses]
    return index, center, half, lowest[index], highest[index]


def _reach_along(direction: Float64, extents: Float64, axes: Float64) -> Float64:
    """Half extents [M] of the ellipsoids along directions [M, 3]."""
    along = np.einsum("nij,ni->nj", axes, direction)
    return np.asarray(np.sqrt(((along * extents) ** 2).sum(1)))


def _to_row(elevation: Float64) -> NDArray[np.int64]:
    return np.floor(elevation / ROW_RAD).astype(np.int64)


def _split(counts: NDArray[np.int64], limit: int) -> Iterator[slice]:
    """Parts whose counts sum up to about a limit."""
    total = np.cumsum(counts.clip(0))
    begin = 0
    while begin < len(counts):
        done = total[begin - 1] if begin else 0
        end = max(int(np.searchsorted(total, done + limit)), begin + 1)
        yield slice(begin, end)
        begin = end
