"""Simulates a LiDAR sweep: the sensor's pattern of rays at an ego pose, cast through surfaces as the vehicle drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.lidar_simulation.ray_casting import (
    CastSettings,
    RayHits,
    Rays,
    cast_rays,
    prepare_discs,
    select_discs_in_sector,
)
from genre_tasks.lidar_simulation.sweep_pattern import SweepPattern
from genre_tasks.logs.types import Float64
from genre_tasks.scene.graph import DISTANT, SceneGraph

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear sRGB (ITU-R BT.709)."""

_PARTS = 16


@dataclass(frozen=True)
class LidarModel:
    """What comes back of a ray.

    Attributes:
        widenings: factors on discs within their planes. All rays meet the first: discs as narrow as outlines ask for.
            Those that meet nothing then meet the next one: wide enough to close the gaps between a road's rings.
        min_alpha: a ray that less of is blocked has no return.
        min_cosine: between ray and normal; a surface seen more at a slant throws nothing back.
        max_range_m: what is farther does not come back.
        beam_rad: standard deviation of a beam's width.
    """

    widenings: tuple[float, ...] = (0.6, 1.5, 4.0)
    min_alpha: float = 0.3
    min_cosine: float = 0.01
    max_range_m: float = 120.0
    beam_rad: float = 0.0005


@dataclass(frozen=True)
class SimulatedSweep:
    """What a sensor would have measured, ray by ray.

    Attributes:
        frame: of the log, or a moment between two.
        origins: [N, 3] float64 metres, chunk coordinates.
        directions: [N, 3] float64 unit vectors, chunk axes.
        range_m: [N] float64; NaN where nothing comes back.
        intensity: [N] float64 in [0, 1], the luminance of the surface's colour in linear light. It is what a camera
            sees, not what an infrared laser does: paint and plates that throw a laser back are no brighter here.
        times_s: [N] float64 since the frame's time.
        ring: [N] int64 beam from the lowest up; -1 where it is not known.
        node: [N] int64 node of the scene graph; -1 where nothing comes back.
    """

    frame: float
    origins: Float64
    directions: Float64
    range_m: Float64
    intensity: Float64
    times_s: Float64
    ring: NDArray[np.int64]
    node: NDArray[np.int64]

    @property
    def points(self) -> Float64:
        """Points [N, 3] of all rays, chunk coordinates; NaN where nothing comes back."""
        return self.origins + self.directions * self.range_m[:, None]


def simulate_sweep(
    surfaces: SceneGraph,
    pattern: SweepPattern,
    frame: float,
    chunk_SE3_ego: Float64,
    ego_times_s: Float64,
    model: LidarModel | None = None,
) -> SimulatedSweep:
    """Simulates one sweep.

    Actors are where their boxes are at the frame, for all of the sweep: annotators fit boxes to a sweep's points, and
    those are measured when the beams pass.

    Args:
        surfaces: what the rays meet, as of ``LidarSurfaces``, or any scene.
        pattern: the rays, as of ``build_pattern``.
        frame: of the log, or a moment between two.
        chunk_SE3_ego: [P, 4, 4] poses around the frame, chunk coordinates.
        ego_times_s: [P] of these poses since the frame's time; 0 is among them, or between them.
        model: what comes back; ``None``: the default one.

    Returns:
        The sweep.
    """
    model = model or LidarModel()
    pose = interpolate_poses(chunk_SE3_ego, ego_times_s, pattern.times_s)
    origins = pose[:, :3, 3] + pose[:, :3, :3] @ pattern.sensor.position_m
    directions = np.einsum("nij,nj->ni", pose[:, :3, :3], pattern.directions)
    hits = _cast_in_parts(surfaces, Rays(origins, directions), pattern.times_s, frame, model)
    with np.errstate(invalid="ignore"):
        returns = (hits.range_m <= model.max_range_m) & (hits.cosine >= model.min_cosine) & (hits.node != DISTANT)
    return SimulatedSweep(
        frame=frame,
        origins=origins,
        directions=directions,
        range_m=np.where(returns, hits.range_m, np.nan),
        intensity=np.where(returns, _to_luminance(hits.color), np.nan),
        times_s=pattern.times_s,
        ring=pattern.ring,
        node=np.where(returns, hits.node, -1),
    )


def _cast_in_parts(surfaces: SceneGraph, rays: Rays, times_s: Float64, frame: float, model: LidarModel) -> RayHits:
    with torch.no_grad():
        splats = surfaces.gaussians_at(frame).activate()
    nodes = surfaces.nodes.numpy()
    center = rays.origins.mean(0)
    settings = CastSettings(min_alpha=model.min_alpha)
    rows = np.arange(len(rays))
    found: dict[str, NDArray] = {}
    # Outlines first: discs wide enough to close a road's gaps would make every post a wall.
    for widening in model.widenings:
        discs = prepare_discs(splats, nodes, center, widening=widening, beam_rad=model.beam_rad)
        # In parts of the turn, within which the sensor moves by centimetres.
        for part in np.array_split(rows[np.argsort(times_s[rows], kind="stable")], _PARTS):
            some = Rays(rays.origins[part], rays.directions[part])
            hits = cast_rays(select_discs_in_sector(discs, some), some, settings)
            for name, values in vars(hits).items():
                if name not in found:
                    found[name] = np.zeros((len(rays), *values.shape[1:]), values.dtype)
                found[name][part] = values
        rows = np.flatnonzero(np.isnan(found["range_m"]))
    return RayHits(**found)


def _to_luminance(srgb: Float64) -> Float64:
    limited = srgb.clip(0, 1)
    linear = np.where(limited <= 0.04045, limited / 12.92, ((limited + 0.055) / 1.055) ** 2.4)
    return np.asarray((linear @ LUMINANCE).clip(0, 1))
