"""What stands on pavements: trees, lamps, signs, bins, benches, bollards, hedges. Each in its own frame, z up."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, boxes, ellipsoid, joined, soup, tube
from genre_tasks.logs.types import Float64


def tree(rng: np.random.Generator, height: float, leaves: int) -> Mesh:
    """A trunk, a few boughs and a crown of ``leaves`` triangles gathered in clumps."""
    brown, green = (
        rng.uniform(0.25, 0.4) * np.array([1, 0.8, 0.62]),
        np.array([0.32, 0.44, 0.17]) * rng.uniform(0.8, 1.15),
    )
    fork = height * rng.uniform(0.3, 0.42)
    lean = rng.uniform(-0.25, 0.25, 2)
    top = np.array([*lean, fork])
    parts = [tube(np.stack([[0, 0, -0.3], top]), [0.05 + height * 0.022, height * 0.016], 8, Material.BARK, brown)]
    clumps = int(rng.integers(6, 10))
    spread = height * rng.uniform(0.2, 0.28)
    angle = np.arange(clumps) * 2.4 + rng.uniform(0, 6)
    reach = spread * np.sqrt((np.arange(clumps) + 0.3) / clumps) * rng.uniform(0.8, 1.15, clumps)
    rise = height - spread * 0.8 - (reach / spread) ** 2 * height * 0.22 - rng.uniform(0, 0.12, clumps) * height
    centres = np.stack([top[0] + reach * np.cos(angle), top[1] + reach * np.sin(angle), rise], 1)
    for centre in centres:
        parts.append(tube([top * 0.97, centre], [height * 0.010, 0.02], 5, Material.BARK, brown))
    owner = rng.integers(clumps, size=leaves)
    direction = rng.normal(size=(leaves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = spread * 0.62 * rng.uniform(0.35, 1.0, leaves) ** 0.5
    parts.append(_leaves(rng, centres[owner] + direction * radius[:, None] * [1, 1, 0.8], height * 0.05, green))
    return joined(parts)


def _leaves(rng: np.random.Generator, at: Float64, size: float, green: Float64) -> Mesh:
    """Randomly turned triangles, darker towards the bottom of the crown."""
    n = len(at)
    corners = at[:, None] + rng.normal(size=(n, 3, 3)) * size
    share = (at[:, 2] - at[:, 2].min()) / max(np.ptp(at[:, 2]), 1e-6)
    free = np.stack([0.25 + 0.5 * share + 0.4 * (rng.random(n) - 0.5), rng.random(n) ** 2, 0 * share, 0 * share], 1)
    return soup(corners, None, Material.LEAF, green, free)


def hedge(rng: np.random.Generator, length: float) -> Mesh:
    """A clipped hedge along x."""
    n = int(length * 55)
    at = rng.uniform([0, -0.35, 0.05], [length, 0.35, 1.1], (n, 3))
    core = boxes((0, -0.28, 0), (length, 0.28, 1.0), Material.LEAF, (0.16, 0.25, 0.1), (0.4, 0.2, 0, 0))
    return joined([core, _leaves(rng, at, 0.11, np.array([0.3, 0.42, 0.18]))])


def lamp(rng: np.random.Generator, height: float) -> Mesh:
    """A street lamp whose arm reaches along +y."""
    grey = (rng.uniform(0.2, 0.5),) * 3
    return joined(
        [
            tube([[0, 0, -0.2], [0, 0, 1.0]], [0.11, 0.10], 10, Material.METAL, grey),
            tube([[0, 0, 1.0], [0, 0, height]], [0.075, 0.05], 10, Material.METAL, grey),
            tube([[0, 0, height], [0, 1.6, height + 0.25]], [0.045, 0.04], 8, Material.METAL, grey),
            boxes((-0.13, 1.3, height + 0.12), (0.13, 2.0, height + 0.28), Material.METAL, grey),
            boxes((-0.1, 1.35, height + 0.08), (0.1, 1.95, height + 0.12), Material.LAMP, (0.9, 0.9, 0.8)),
        ]
    )


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign that looks along −x."""
    half = rng.uniform(0.28, 0.4)
    height = rng.uniform(2.1, 2.6)
    colour = ((0.75, 0.12, 0.12), (0.12, 0.28, 0.65), (0.85, 0.65, 0.1))[rng.integers(3)]
    kind = float(rng.integers(2))
    free = (half, kind, rng.random(), 0.0)
    if kind:
        corners = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]) * half
        flat = np.stack([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    else:
        a = np.linspace(0, 2 * np.pi, 17)
        rim = np.stack([0 * a, np.cos(a), np.sin(a)], 1) * half
        flat = np.stack([np.zeros((16, 3)), rim[:-1], rim[1:]], 1)
    plate = soup(np.add(flat, [-0.06, 0, height]), flat, Material.SIGN, colour, free)
    back = soup(np.add(flat, [-0.045, 0, height]), None, Material.METAL, (0.5, 0.5, 0.5))
    axis = np.array([[0, 0, -0.2], [0, 0, height + half]])
    pole = tube(axis, [0.035, 0.035], 8, Material.METAL, (0.55, 0.55, 0.55))
    return joined([plate, back, pole])


def bin_(rng: np.random.Generator) -> Mesh:
    colour = rng.uniform(0.1, 0.5, 3)
    body = tube([[0.0, 0.0, 0.0], [0.0, 0.0, 0.85]], [0.24, 0.28], 10, Material.METAL, colour)
    return joined([body, tube([[0.0, 0.0, 0.85], [0.0, 0.0, 1.0]], [0.3, 0.18], 10, Material.METAL, colour * 0.6)])


def bench(rng: np.random.Generator) -> Mesh:
    """A bench along x that looks towards +y."""
    brown = np.array([0.5, 0.33, 0.2]) * rng.uniform(0.7, 1.2)
    seat = [boxes((-0.8, y, 0.43), (0.8, y + 0.11, 0.47), Material.WOOD, brown) for y in (-0.2, -0.05, 0.1)]
    back = [boxes((-0.8, -0.27, z), (0.8, -0.23, z + 0.1), Material.WOOD, brown) for z in (0.6, 0.76)]
    legs = [boxes((x - 0.03, -0.25, 0), (x + 0.03, 0.2, 0.43), Material.METAL, (0.15,) * 3) for x in (-0.65, 0.65)]
    return joined([*seat, *back, *legs])


def bollard(rng: np.random.Generator) -> Mesh:
    colour = (rng.uniform(0.15, 0.6),) * 3
    post = tube([[0, 0, -0.1], [0, 0, 0.8]], [0.08, 0.07], 8, Material.METAL, colour)
    return joined([post, ellipsoid((0, 0, 0.82), (0.09, 0.09, 0.09), Material.METAL, colour)])
