"""What stands on pavements: trees, lamps, signs, bins, benches, bollards, hedges.

Each stands in its own frame: z up, origin on the ground.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import (
    Mesh,
    Surface,
    box_mesh,
    ellipsoid_mesh,
    join_meshes,
    triangle_mesh,
    tube_mesh,
)
from genre_tasks.logs.types import Float64

_SIGN_COLOURS = ((0.75, 0.12, 0.12), (0.12, 0.28, 0.65), (0.85, 0.65, 0.1))


def build_tree(rng: np.random.Generator, height: float, leaves: int) -> Mesh:
    """Builds a trunk, a few boughs and a crown of leaves gathered in clumps.

    Args:
        rng: draws shape and colours.
        height: metres.
        leaves: triangles of the crown.

    Returns:
        The tree.
    """
    bark = Surface(Material.BARK, rng.uniform(0.25, 0.4) * np.array([1, 0.8, 0.62]))
    green = np.array([0.32, 0.44, 0.17]) * rng.uniform(0.8, 1.15)
    fork = height * rng.uniform(0.3, 0.42)
    lean = rng.uniform(-0.25, 0.25, 2)
    top = np.array([*lean, fork])
    trunk = np.stack([[0, 0, -0.3], top])
    parts = [tube_mesh(trunk, [0.05 + height * 0.022, height * 0.016], 8, bark)]
    clumps = int(rng.integers(6, 10))
    spread = height * rng.uniform(0.2, 0.28)
    # Clumps turn by 2.4 rad (the golden angle) each, as leaves around a stem, so that none is above another.
    angle = np.arange(clumps) * 2.4 + rng.uniform(0, 6)
    # The root spreads clumps evenly over the area of the crown.
    reach = spread * np.sqrt((np.arange(clumps) + 0.3) / clumps) * rng.uniform(0.8, 1.15, clumps)
    rise = height - spread * 0.8 - (reach / spread) ** 2 * height * 0.22 - rng.uniform(0, 0.12, clumps) * height
    centres = np.stack([top[0] + reach * np.cos(angle), top[1] + reach * np.sin(angle), rise], 1)
    for centre in centres:
        parts.append(tube_mesh([top * 0.97, centre], [height * 0.010, 0.02], 5, bark))
    clump = rng.integers(clumps, size=leaves)
    direction = rng.normal(size=(leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # Towards the outside of a clump, where leaves get light.
    radius = spread * 0.62 * rng.uniform(0.35, 1.0, leaves) ** 0.5
    positions = centres[clump] + direction * radius[:, None] * [1, 1, 0.8]
    parts.append(_build_leaves(rng, positions, height * 0.05, green))
    return join_meshes(parts)


def _build_leaves(rng: np.random.Generator, positions: Float64, size: float, green: Float64) -> Mesh:
    """Randomly turned triangles at positions [n, 3], darker towards the bottom of the crown."""
    count = len(positions)
    corners = positions[:, None] + rng.normal(size=(count, 3, 3)) * size
    bottom = positions[:, 2].min()
    relative_height = (positions[:, 2] - bottom) / max(np.ptp(positions[:, 2]), 1e-6)
    # Lower leaves are darker by themselves: ambient light knows no occlusion, and would light a crown evenly.
    brightness = 0.25 + 0.5 * relative_height + 0.4 * (rng.random(count) - 0.5)
    yellowness = rng.random(count) ** 2
    zeros = 0 * relative_height
    parameters = np.stack([brightness, yellowness, zeros, zeros], 1)
    return triangle_mesh(corners, None, Surface(Material.LEAF, green, parameters))


def build_hedge(rng: np.random.Generator, length: float) -> Mesh:
    """Builds a clipped hedge along x.

    Args:
        rng: draws its leaves.
        length: metres.

    Returns:
        The hedge, from x = 0 to its length.
    """
    positions = rng.uniform([0, -0.35, 0.05], [length, 0.35, 1.1], (int(length * 55), 3))
    core = Surface(Material.LEAF, (0.16, 0.25, 0.1), (0.4, 0.2, 0, 0))
    return join_meshes(
        [
            # Seen between the leaves; without it one would look through the hedge.
            box_mesh((0, -0.28, 0), (length, 0.28, 1.0), core),
            _build_leaves(rng, positions, 0.11, np.array([0.3, 0.42, 0.18])),
        ]
    )


def build_lamp(rng: np.random.Generator, height: float) -> Mesh:
    """Builds a street lamp whose arm reaches along +y.

    Args:
        rng: draws its grey.
        height: of the pole, metres.

    Returns:
        The lamp.
    """
    metal = Surface(Material.METAL, (rng.uniform(0.2, 0.5),) * 3)
    bulb = Surface(Material.LAMP, (0.9, 0.9, 0.8))
    return join_meshes(
        [
            tube_mesh([[0, 0, -0.2], [0, 0, 1.0]], [0.11, 0.10], 10, metal),
            tube_mesh([[0, 0, 1.0], [0, 0, height]], [0.075, 0.05], 10, metal),
            tube_mesh([[0, 0, height], [0, 1.6, height + 0.25]], [0.045, 0.04], 8, metal),
            box_mesh((-0.13, 1.3, height + 0.12), (0.13, 2.0, height + 0.28), metal),
            box_mesh((-0.1, 1.35, height + 0.08), (0.1, 1.95, height + 0.12), bulb),
        ]
    )


def build_sign(rng: np.random.Generator) -> Mesh:
    """Builds a traffic sign that looks along −x.

    Args:
        rng: draws size, shape and colour.

    Returns:
        Plate, back and pole.
    """
    half = rng.uniform(0.28, 0.4)
    height = rng.uniform(2.1, 2.6)
    colour = _SIGN_COLOURS[rng.integers(3)]
    is_square = float(rng.integers(2))
    symbol = rng.random()
    if is_square:
        corners = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]) * half
        plate = np.stack([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    else:
        angle = np.linspace(0, 2 * np.pi, 17)
        rim = np.stack([0 * angle, np.cos(angle), np.sin(angle)], 1) * half
        plate = np.stack([np.zeros((16, 3)), rim[:-1], rim[1:]], 1)
    face = Surface(Material.SIGN, colour, (half, is_square, symbol, 0.0))
    back = Surface(Material.METAL, (0.5, 0.5, 0.5))
    pole = Surface(Material.METAL, (0.55, 0.55, 0.55))
    return join_meshes(
        [
            triangle_mesh(np.add(plate, [-0.06, 0, height]), plate, face),
            # The plate has a back: signs are seen from behind by the back camera.
            triangle_mesh(np.add(plate, [-0.045, 0, height]), None, back),
            tube_mesh([[0, 0, -0.2], [0, 0, height + half]], [0.035, 0.035], 8, pole),
        ]
    )


def build_bin(rng: np.random.Generator) -> Mesh:
    """Builds a litter bin with a lid.

    Args:
        rng: draws its colour.

    Returns:
        The bin.
    """
    colour = rng.uniform(0.1, 0.5, 3)
    body = Surface(Material.METAL, colour)
    lid = Surface(Material.METAL, colour * 0.6)
    return join_meshes(
        [
            tube_mesh([[0.0, 0.0, 0.0], [0.0, 0.0, 0.85]], [0.24, 0.28], 10, body),
            tube_mesh([[0.0, 0.0, 0.85], [0.0, 0.0, 1.0]], [0.3, 0.18], 10, lid),
        ]
    )


def build_bench(rng: np.random.Generator) -> Mesh:
    """Builds a bench along x that looks towards +y.

    Args:
        rng: draws its brown.

    Returns:
        The bench.
    """
    wood = Surface(Material.WOOD, np.array([0.5, 0.33, 0.2]) * rng.uniform(0.7, 1.2))
    metal = Surface(Material.METAL, (0.15,) * 3)
    seat = [box_mesh((-0.8, y, 0.43), (0.8, y + 0.11, 0.47), wood) for y in (-0.2, -0.05, 0.1)]
    back = [box_mesh((-0.8, -0.27, z), (0.8, -0.23, z + 0.1), wood) for z in (0.6, 0.76)]
    legs = [box_mesh((x - 0.03, -0.25, 0), (x + 0.03, 0.2, 0.43), metal) for x in (-0.65, 0.65)]
    return join_meshes([*seat, *back, *legs])


def build_bollard(rng: np.random.Generator) -> Mesh:
    """Builds a bollard with a round top.

    Args:
        rng: draws its grey.

    Returns:
        The bollard.
    """
    metal = Surface(Material.METAL, (rng.uniform(0.15, 0.6),) * 3)
    post = tube_mesh([[0, 0, -0.1], [0, 0, 0.8]], [0.08, 0.07], 8, metal)
    return join_meshes([post, ellipsoid_mesh((0, 0, 0.82), (0.09, 0.09, 0.09), metal)])
