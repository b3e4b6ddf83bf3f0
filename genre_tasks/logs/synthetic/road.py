"""The street's centre curve, its cross-section, and the surfaces one drives and walks on.

Street coordinates: ``s`` metres along the ego lane's centre, ``t`` metres to the left of it. Positions and poses are in
the street's own Cartesian frame (z up, origin at s = t = 0), which the log shifts by its world offset. Everything
within 5 m of the ego lane's centre is kept free of standing things, so that a camera shifted by ±5 m is never inside
one.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import SIDES, Mesh, Surface, grid_mesh, join_meshes
from genre_tasks.logs.types import Float64

LANE_M = 3.5
KERB_HEIGHT_M = 0.14
_KERB_WIDTH_M = 0.28
_GRID_STEP_M = 0.25
_GRID_RANGE_M = (-260.0, 700.0)
_SURFACE_STEP_M = 2.0
_HILL_LENGTH_M = 40

Reals = Float64 | float


def make_generator(seed: int, subject: str) -> np.random.Generator:
    """Gives every subject a random stream for itself: a change to trees leaves the buildings as they were.

    Args:
        seed: of the street.
        subject: such as ``road`` or ``buildings 1``.

    Returns:
        A generator that depends on both alone.

    >>> make_generator(1, "road").random() == make_generator(1, "road").random()
    True
    """
    return np.random.default_rng([seed, zlib.crc32(subject.encode())])


@dataclass(frozen=True)
class Curve:
    """The shape of the street's centre line, as a function of s.

    Attributes:
        heading_rad: yaw at s = 0.
        curvature_per_m: of the circle that the street follows.
        sway_rad: amplitude of the heading's swings to both sides.
        phase_rad: of those swings.
        hill_m: half the height from valley to hilltop; its sign says which comes first.
    """

    heading_rad: float
    curvature_per_m: float
    sway_rad: float
    phase_rad: float
    hill_m: float


@dataclass(frozen=True)
class CrossSection:
    """Where things are across the street.

    Attributes:
        right_kerb: t of the kerb on the right, metres, negative.
        left_kerb: t of the kerb on the left.
        right_front: t of the building line on the right, negative.
        left_front: t of the building line on the left.
        oncoming: t of the centre of every oncoming lane.
    """

    right_kerb: float
    left_kerb: float
    right_front: float
    left_front: float
    oncoming: tuple[float, ...]

    def kerb(self, side: int) -> float:
        """Finds the kerb.

        Args:
            side: +1 left, -1 right.

        Returns:
            Its t, metres.
        """
        return self.left_kerb if side > 0 else self.right_kerb

    def front(self, side: int) -> float:
        """Finds the building line.

        Args:
            side: +1 left, -1 right.

        Returns:
            Its t, metres.
        """
        return self.left_front if side > 0 else self.right_front


class Road:
    """Curve and cross-section of one seed.

    Args:
        seed: of the street.

    Attributes:
        section: the cross-section, the same all along.
        curve: the shape of the centre line.
        crossings: [12] s of the zebra crossings, metres.
    """

    def __init__(self, seed: int) -> None:
        rng = make_generator(seed, "road")
        # The order of the draws is the street: another order is another street of the same seed.
        is_wide = rng.random() < 0.5
        right_kerb = -8.25 - rng.uniform(0.0, 0.5)
        left_kerb = (8.25 + LANE_M if is_wide else 8.25) + rng.uniform(0.0, 0.5)
        self.section = CrossSection(
            right_kerb=right_kerb,
            left_kerb=left_kerb,
            right_front=right_kerb - rng.uniform(2.6, 5.0),
            left_front=left_kerb + rng.uniform(2.6, 5.0),
            oncoming=(LANE_M, 2 * LANE_M) if is_wide else (LANE_M,),
        )
        self.curve = Curve(
            heading_rad=rng.uniform(-np.pi, np.pi),
            curvature_per_m=rng.uniform(-1, 1) / 900,
            sway_rad=rng.uniform(0.02, 0.07),
            phase_rad=rng.uniform(0, 2 * np.pi),
            hill_m=rng.uniform(-0.35, 0.35),
        )
        # The first one may lie 30 m behind the start, so that crossings are not all ahead of the vehicle.
        self.crossings = np.cumsum(rng.uniform(45, 90, 12)) - 75.0

    @cached_property
    def _table(self) -> tuple[Float64, Float64, Float64]:
        """Grid of s [G], positions [G, 3] and headings [G]; s = 0 is the origin."""
        # Positions are integrals of the heading, which have no closed form.
        s = np.arange(_GRID_RANGE_M[0], _GRID_RANGE_M[1] + _GRID_STEP_M, _GRID_STEP_M)
        curve = self.curve
        sway = curve.sway_rad * (np.sin(s / 45 + curve.phase_rad) - np.sin(curve.phase_rad))
        heading = curve.heading_rad + curve.curvature_per_m * s + sway
        # The midpoint rule: its error is far below that of either end.
        middle = (heading[1:] + heading[:-1]) / 2
        x = np.concatenate([[0.0], np.cumsum(np.cos(middle))]) * _GRID_STEP_M
        y = np.concatenate([[0.0], np.cumsum(np.sin(middle))]) * _GRID_STEP_M
        z = curve.hill_m * (1 - np.cos(s / _HILL_LENGTH_M))
        origin = int(np.argmin(np.abs(s)))
        return s, np.stack([x - x[origin], y - y[origin], z], 1), heading

    def heading(self, s: Reals) -> Float64:
        """Finds the direction of the centre line.

        Args:
            s: [...] metres.

        Returns:
            [...] yaw, radians.
        """
        grid, _, heading = self._table
        return np.asarray(np.interp(s, grid, heading))

    def slope(self, s: Reals) -> Float64:
        """Finds how steep the street is.

        Args:
            s: [...] metres.

        Returns:
            [...] dz/ds.
        """
        return np.asarray(self.curve.hill_m * np.sin(np.asarray(s) / _HILL_LENGTH_M) / _HILL_LENGTH_M)

    def position(self, s: Reals, t: Reals, height: Reals = 0.0) -> Float64:
        """Converts street coordinates to positions.

        Args:
            s: [...] metres.
            t: [...] metres.
            height: [...] metres above the road.

        Returns:
            [..., 3] metres.

        >>> Road(0).position(0.0, 0.0, 2.0)
        array([0., 0., 2.])
        """
        grid, positions, _ = self._table
        s, t, height = np.broadcast_arrays(np.asarray(s, float), np.asarray(t, float), np.asarray(height, float))
        centre = np.stack([np.interp(s, grid, positions[:, axis]) for axis in range(3)], -1)
        yaw = self.heading(s)
        return centre + np.stack([-np.sin(yaw) * t, np.cos(yaw) * t, height], -1)

    def pose(self, s: Reals, t: Reals, height: Reals = 0.0, yaw: Reals = 0.0) -> Float64:
        """Poses something that stands on the road and is pitched with it, such as a car.

        Args:
            s: [...] metres.
            t: [...] metres.
            height: [...] metres above the road.
            yaw: [...] radians, turned from the street's direction to the left.

        Returns:
            [..., 4, 4] street_SE3_object: x along the street (turned by ``yaw``), y left, z up.
        """
        s = np.asarray(s, float)
        heading = self.heading(s) + yaw
        # Something that stands across the street is not pitched but would roll; it is left upright.
        pitch = np.arctan(self.slope(s)) * np.cos(yaw)
        cos_yaw = np.cos(heading)
        sin_yaw = np.sin(heading)
        cos_pitch = np.cos(pitch)
        sin_pitch = np.sin(pitch)
        out = _poses_at(self.position(s, t, height))
        out[..., 0, :3] = np.stack([cos_yaw * cos_pitch, -sin_yaw, -cos_yaw * sin_pitch], -1)
        out[..., 1, :3] = np.stack([sin_yaw * cos_pitch, cos_yaw, -sin_yaw * sin_pitch], -1)
        out[..., 2, :3] = np.stack([sin_pitch, np.zeros_like(sin_pitch), cos_pitch], -1)
        return out

    def upright_pose(self, s: Reals, t: Reals, height: Reals = 0.0, yaw: Reals = 0.0) -> Float64:
        """Poses something that is plumb whatever the slope: houses, poles, people.

        Args:
            s: [...] metres.
            t: [...] metres.
            height: [...] metres above the road.
            yaw: [...] radians, turned from the street's direction to the left.

        Returns:
            [..., 4, 4] street_SE3_object: x along the street (turned by ``yaw``), y left, z up.
        """
        heading = self.heading(s) + yaw
        out = _poses_at(self.position(s, t, height))
        out[..., 0, 0] = np.cos(heading)
        out[..., 0, 1] = -np.sin(heading)
        out[..., 1, 0] = np.sin(heading)
        out[..., 1, 1] = np.cos(heading)
        out[..., 2, 2] = 1.0
        return out


def _poses_at(positions: Float64) -> Float64:
    """[..., 4, 4] poses at positions [..., 3] whose rotations are still to be filled in."""
    out = np.zeros((*positions.shape[:-1], 4, 4))
    out[..., :3, 3] = positions
    out[..., 3, 3] = 1.0
    return out


def road_mesh(road: Road, start: float, end: float) -> Mesh:
    """Builds carriageway, kerbs, pavements and the land behind the buildings.

    Args:
        road: the street.
        start: s at which the surfaces begin, metres.
        end: s at which they end.

    Returns:
        The surfaces, in the street's frame.
    """
    section = road.section
    s = np.arange(start, end + _SURFACE_STEP_M, _SURFACE_STEP_M)

    def strip(ts: Sequence[float], heights: Sequence[float], material: int, colour: Sequence[float]) -> Mesh:
        """A surface between lines along the street, each at one t and height above the road."""
        grid = np.stack([road.position(s, t, height) for t, height in zip(ts, heights, strict=True)], 1)
        across = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(ts), np.diff(heights)))]) + ts[0]
        along, across = np.broadcast_arrays(s[:, None], across[None, :])
        texture = np.stack([along, across, np.zeros((len(s), len(ts)))], -1)
        middle = ((s[1:] + s[:-1]) / 2).repeat(len(ts) - 1)
        # Found per quad: a texture sees one point at a time.
        nearest_crossing = road.crossings[np.abs(road.crossings - middle[:, None]).argmin(1)]
        # What the road texture must know of the street to paint its markings.
        constants = (section.right_kerb, section.left_kerb, len(section.oncoming))
        parameters = np.stack([*(np.full_like(middle, value) for value in constants), nearest_crossing], 1)
        return grid_mesh(grid, texture, Surface(material, colour, parameters))

    right = section.right_kerb
    left = section.left_kerb
    top = KERB_HEIGHT_M
    parts = [strip([right, (right + left) / 2, left], [0, 0, 0], Material.ROAD, (0.33, 0.33, 0.34))]
    for side in SIDES:
        kerb = section.kerb(side)
        inner_edge = kerb + side * _KERB_WIDTH_M
        # Under the houses, so that no gap opens where a façade is set back.
        outer_edge = section.front(side) + side * 1.5
        horizon = section.front(side) + side * 90
        parts.append(strip([kerb, kerb, inner_edge], [0, top, top], Material.KERB, (0.62, 0.61, 0.58)))
        parts.append(strip([inner_edge, outer_edge], [top, top], Material.PAVEMENT, (0.60, 0.58, 0.55)))
        parts.append(strip([outer_edge, horizon], [top - 0.02, top - 0.02], Material.GRASS, (0.35, 0.42, 0.22)))
    return join_meshes(parts)
