"""The street's centre curve, its cross-section, and the surfaces one drives and walks on.

Street coordinates: ``s`` metres along the ego lane's centre, ``t`` metres to the left of it. Everything within 5 m of
the ego lane's centre is kept free of standing things, so that a camera shifted by ±5 m is never inside one.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, joined, sheet
from genre_tasks.logs.types import Float64

LANE_M = 3.5
KERB_HEIGHT_M = 0.14
_GRID_STEP_M = 0.25
_GRID_M = (-260.0, 700.0)


def generator(seed: int, subject: str) -> np.random.Generator:
    """A stream of its own for each subject: a change to trees leaves the buildings as they were."""
    return np.random.default_rng([seed, zlib.crc32(subject.encode())])


@dataclass(frozen=True)
class CrossSection:
    """Where things are across the street, metres left of the ego lane's centre."""

    right_kerb: float
    left_kerb: float
    right_front: float
    left_front: float
    oncoming: tuple[float, ...]
    bends: tuple[float, float, float, float, float]

    def kerb(self, side: int) -> float:
        """``side`` +1 left, −1 right."""
        return self.left_kerb if side > 0 else self.right_kerb

    def front(self, side: int) -> float:
        """The building line."""
        return self.left_front if side > 0 else self.right_front


class Road:
    """Curve and cross-section of one seed."""

    def __init__(self, seed: int) -> None:
        rng = generator(seed, "road")
        wide = rng.random() < 0.5
        right = -8.25 - rng.uniform(0.0, 0.5)
        left = (8.25 + LANE_M if wide else 8.25) + rng.uniform(0.0, 0.5)
        self.section = CrossSection(
            right_kerb=right,
            left_kerb=left,
            right_front=right - rng.uniform(2.6, 5.0),
            left_front=left + rng.uniform(2.6, 5.0),
            oncoming=(LANE_M, 2 * LANE_M) if wide else (LANE_M,),
            bends=(
                rng.uniform(-np.pi, np.pi),
                rng.uniform(-1, 1) / 900,
                rng.uniform(0.02, 0.07),
                rng.uniform(0, 2 * np.pi),
                rng.uniform(-0.35, 0.35),
            ),
        )
        self.crossings = np.cumsum(rng.uniform(45, 90, 12)) - 75.0

    @cached_property
    def _table(self) -> tuple[Float64, Float64, Float64]:
        """Grid of s [G], positions [G, 3] and headings [G]; s = 0 is the origin."""
        s = np.arange(_GRID_M[0], _GRID_M[1] + _GRID_STEP_M, _GRID_STEP_M)
        heading0, curvature, sway, phase, hill = self.section.bends
        heading = heading0 + curvature * s + sway * (np.sin(s / 45 + phase) - np.sin(phase))
        mid = (heading[1:] + heading[:-1]) / 2
        x = np.concatenate([[0.0], np.cumsum(np.cos(mid))]) * _GRID_STEP_M
        y = np.concatenate([[0.0], np.cumsum(np.sin(mid))]) * _GRID_STEP_M
        z = hill * (1 - np.cos(s / 40))
        zero = int(np.argmin(np.abs(s)))
        return s, np.stack([x - x[zero], y - y[zero], z], 1), heading

    def heading(self, s: Float64 | float) -> Float64:
        """Yaw of the curve, radians."""
        grid, _, heading = self._table
        return np.asarray(np.interp(s, grid, heading))

    def slope(self, s: Float64 | float) -> Float64:
        """dz/ds."""
        return np.asarray(self.section.bends[4] * np.sin(np.asarray(s) / 40) / 40)

    def point(self, s: Float64 | float, t: Float64 | float, height: Float64 | float = 0.0) -> Float64:
        """[..., 3] position of street coordinates, ``height`` above the road."""
        grid, position, _ = self._table
        s, t, height = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float), np.asarray(height, float))
        base = np.stack([np.interp(s, grid, position[:, k]) for k in range(3)], -1)
        yaw = self.heading(s)
        return base + np.stack([-np.sin(yaw) * t, np.cos(yaw) * t, height], -1)

    def pose(
        self, s: Float64 | float, t: Float64 | float, height: Float64 | float = 0.0, yaw: Float64 | float = 0.0
    ) -> Float64:
        """[..., 4, 4] pose on the road, pitched with it: x along the street (turned by ``yaw``), y left, z up."""
        s = np.asarray(s, float)
        heading = self.heading(s) + yaw
        pitch = np.arctan(self.slope(s)) * np.cos(yaw)
        c, n, cp, sp = np.cos(heading), np.sin(heading), np.cos(pitch), np.sin(pitch)
        position = self.point(s, t, height)
        out = np.zeros((*position.shape[:-1], 4, 4))
        out[..., 0, :3] = np.stack([c * cp, -n, -c * sp], -1)
        out[..., 1, :3] = np.stack([n * cp, c, -n * sp], -1)
        out[..., 2, :3] = np.stack([sp, np.zeros_like(sp), cp], -1)
        out[..., :3, 3] = position
        out[..., 3, 3] = 1.0
        return out

    def upright(
        self, s: Float64 | float, t: Float64 | float, height: Float64 | float = 0.0, yaw: Float64 | float = 0.0
    ) -> Float64:
        """[..., 4, 4] like ``pose``, but plumb, whatever the slope: houses, poles, people."""
        heading = self.heading(s) + yaw
        position = self.point(s, t, height)
        out = np.zeros((*position.shape[:-1], 4, 4))
        c, n = (
            np.broadcast_to(np.cos(heading), position.shape[:-1]),
            np.broadcast_to(np.sin(heading), position.shape[:-1]),
        )
        out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = c, -n, n, c
        out[..., 2, 2] = out[..., 3, 3] = 1.0
        out[..., :3, 3] = position
        return out


def road_surfaces(road: Road, start: float, end: float) -> Mesh:
    """Carriageway, kerbs, pavements and the land beyond, from ``start`` to ``end``."""
    section = road.section
    s = np.arange(start, end + 2.0, 2.0)

    def strip(ts: list[float], heights: list[float], material: int, colour: tuple[float, float, float]) -> Mesh:
        grid = np.stack([road.point(s, t, h) for t, h in zip(ts, heights, strict=True)], 1)
        across = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(ts), np.diff(heights)))]) + ts[0]
        tex = np.stack([*np.broadcast_arrays(s[:, None], across[None, :]), np.zeros((len(s), len(ts)))], -1)
        middle = ((s[1:] + s[:-1]) / 2).repeat(len(ts) - 1)
        nearest = road.crossings[np.abs(road.crossings - middle[:, None]).argmin(1)]
        free = np.stack(
            [np.full_like(middle, v) for v in (section.right_kerb, section.left_kerb, len(section.oncoming))], 1
        )
        return sheet(grid, tex, material, colour, np.concatenate([free, nearest[:, None]], 1))

    r, le, up = section.right_kerb, section.left_kerb, KERB_HEIGHT_M
    grey, stone, slab = (0.33, 0.33, 0.34), (0.62, 0.61, 0.58), (0.60, 0.58, 0.55)
    parts = [strip([r, (r + le) / 2, le], [0, 0, 0], Material.ROAD, grey)]
    for side in (1, -1):
        k, f = section.kerb(side), section.front(side)
        parts.append(strip([k, k, k + side * 0.28], [0, up, up], Material.KERB, stone))
        parts.append(strip([k + side * 0.28, f + side * 1.5], [up, up], Material.PAVEMENT, slab))
        parts.append(strip([f + side * 1.5, f + side * 90], [up - 0.02, up - 0.02], Material.GRASS, (0.35, 0.42, 0.22)))
    return joined(parts)
