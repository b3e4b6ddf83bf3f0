"""Façades: openings in bays and storeys, the wall around them, and the panes in them.

The façade is the plane y = 0 of its building: x along it, y into the building, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, Surface, join_meshes, quad_mesh, wall_mesh
from genre_tasks.logs.types import Float64

Values = Float64 | float


@dataclass(frozen=True)
class Openings:
    """Openings of one façade and the bays in which they lie: [N] edges, metres.

    Attributes:
        left: x of the opening's left edge.
        right: x of its right edge.
        bottom: z of its lower edge.
        top: z of its upper edge.
        bay_left: x of the bay's left edge.
        bay_right: x of its right edge.
        bay_bottom: z of its lower edge.
        bay_top: z of its upper edge.
    """

    left: Float64
    right: Float64
    bottom: Float64
    top: Float64
    bay_left: Float64
    bay_right: Float64
    bay_bottom: Float64
    bay_top: Float64

    def __len__(self) -> int:
        return len(self.left)

    def select(self, mask: NDArray[np.bool_]) -> Openings:
        """Picks some of the openings.

        Args:
            mask: [N] which ones.

        Returns:
            The openings where the mask is true.
        """
        return Openings(**{edge.name: getattr(self, edge.name)[mask] for edge in fields(self)})


@dataclass(frozen=True)
class Proportions:
    """Sizes of an opening, relative to its bay.

    Attributes:
        width: share of the bay's width.
        sill: height of the lower edge, as a share of the floor's.
        lintel: height of the upper edge, as a share of the floor's.
    """

    width: float
    sill: float
    lintel: float


@dataclass(frozen=True)
class BayGrid:
    """A regular grid of bays on a façade.

    Attributes:
        bays: how many along the façade.
        bay_m: width of a bay.
        floors: how many above each other.
        base_m: height of the lowest floor above the ground.
        storey_m: height of a floor.
    """

    bays: int
    bay_m: float
    floors: int
    base_m: float
    storey_m: float


def lay_out_openings(grid: BayGrid, sizes: Proportions) -> Openings:
    """Places one opening in every bay.

    Args:
        grid: the bays.
        sizes: of the openings, relative to their bays.

    Returns:
        ``bays`` · ``floors`` openings, floor by floor.

    >>> openings = lay_out_openings(BayGrid(bays=2, bay_m=3.0, floors=1, base_m=0.0, storey_m=3.0),
    ...                             Proportions(width=0.5, sill=0.25, lintel=0.75))
    >>> openings.left, openings.top
    (array([0.75, 3.75]), array([2.25, 2.25]))
    """
    # Floor by floor, which the balconies count on.
    i, j = (index.ravel() for index in np.meshgrid(np.arange(grid.bays), np.arange(grid.floors)))
    left = np.asarray(i * grid.bay_m, np.float64)
    bottom = np.asarray(grid.base_m + j * grid.storey_m, np.float64)
    centre = left + grid.bay_m / 2
    half = grid.bay_m * sizes.width / 2
    return Openings(
        left=centre - half,
        right=centre + half,
        bottom=bottom + grid.storey_m * sizes.sill,
        top=bottom + grid.storey_m * sizes.lintel,
        bay_left=left,
        bay_right=left + grid.bay_m,
        bay_bottom=bottom,
        bay_top=bottom + grid.storey_m,
    )


def stack_corners(corners: Sequence[tuple[Float64, Float64, Float64]]) -> Float64:
    """Puts the corners of polygons together.

    Args:
        corners: x, y and z of each corner in turn, [N] each.

    Returns:
        [N, corners, 3].
    """
    return np.stack([np.stack(corner, -1) for corner in corners], 1)


def upright_rectangles(x0: Float64, x1: Float64, z0: Float64, z1: Float64, y: float) -> Float64:
    """Makes rectangles that are parallel to the façade.

    Args:
        x0: [N] left edges, metres.
        x1: [N] right edges.
        z0: [N] lower edges.
        z1: [N] upper edges.
        y: depth of all of them behind the façade.

    Returns:
        [N, 4, 3] corners.
    """
    depth = np.full_like(x0, y)
    return stack_corners([(x0, depth, z0), (x1, depth, z0), (x1, depth, z1), (x0, depth, z1)])


def boxes_along_axes(
    x: tuple[Values, Values],
    y: tuple[Values, Values],
    z: tuple[Values, Values],
    surface: Surface,
) -> Mesh:
    """Makes boxes from their edges along each axis.

    Args:
        x: lower and upper value, [N] or one for all boxes, metres.
        y: the same along y.
        z: the same along z.
        surface: one, or a row a box.

    Returns:
        N boxes with the texture of a wall.
    """
    low, high = (np.stack(np.broadcast_arrays(x[end], y[end], z[end]), 1) for end in (0, 1))
    return wall_mesh(low, high, surface)


def build_wall_around(openings: Openings, wall: Surface, recess: float) -> Mesh:
    """Builds the wall of each bay around its opening, and the reveals that lead to the pane.

    Args:
        openings: N openings and their bays.
        wall: what the wall is made of.
        recess: depth of the panes behind the façade, metres.

    Returns:
        Wall and reveals.
    """
    f = openings
    # Left and right of the opening over the full height, below and above it over its width.
    flat = np.concatenate(
        [
            upright_rectangles(f.bay_left, f.left, f.bay_bottom, f.bay_top, 0),
            upright_rectangles(f.right, f.bay_right, f.bay_bottom, f.bay_top, 0),
            upright_rectangles(f.left, f.right, f.bay_bottom, f.bottom, 0),
            upright_rectangles(f.left, f.right, f.top, f.bay_top, 0),
        ]
    )
    near = np.zeros_like(f.left)
    far = np.full_like(f.left, recess)
    edges = (
        (f.left, f.bottom, f.left, f.top),
        (f.right, f.bottom, f.right, f.top),
        (f.left, f.bottom, f.right, f.bottom),
        (f.left, f.top, f.right, f.top),
    )
    reveal = np.concatenate(
        [stack_corners([(x0, near, z0), (x1, near, z1), (x1, far, z1), (x0, far, z0)]) for x0, z0, x1, z1 in edges]
    )
    flat_texture = np.stack([flat[..., 0], flat[..., 2], np.zeros_like(flat[..., 0])], -1)
    reveal_texture = np.stack([reveal[..., 0], reveal[..., 2], reveal[..., 1]], -1)
    # A little darker, so that the opening shows also where neither sun nor shadow tells it from the wall.
    darker = replace(wall, colour=np.asarray(wall.colour) * 0.95)
    return join_meshes([quad_mesh(flat, flat_texture, wall), quad_mesh(reveal, reveal_texture, darker)])


def build_panes(
    rng: np.random.Generator,
    openings: Openings,
    material: Material,
    frame: ArrayLike,
    recess: float,
) -> Mesh:
    """Builds panes of glass with their frames.

    Args:
        rng: draws bars and rooms.
        openings: N openings.
        material: ``WINDOW`` or ``SHOP``.
        frame: sRGB of the frames.
        recess: depth behind the façade, metres.

    Returns:
        N panes.
    """
    corners = upright_rectangles(openings.left, openings.right, openings.bottom, openings.top, recess)
    from_corner = corners - corners[:, :1]
    texture = np.stack([from_corner[..., 0], from_corner[..., 2], np.zeros_like(from_corner[..., 0])], -1)
    bars = rng.choice([0.2, 0.5, 0.9])
    # A number for what is behind each pane, so that no two windows look alike.
    rooms = rng.random(len(openings))
    width = openings.right - openings.left
    height = openings.top - openings.bottom
    parameters = np.stack([width, height, rooms, np.full(len(openings), bars)], 1)
    return quad_mesh(corners, texture, Surface(material, frame, parameters))
