"""Buildings: façades with recessed windows, shops, doors, sills, balconies, cornices and chimneys.

A building stands in its own frame: x along the façade from 0 to its width, y into the building, z up; the façade is
the plane y = 0 and looks towards −y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, joined, masonry, quads
from genre_tasks.logs.types import Float64

Colour = tuple[float, float, float]

WALLS: dict[Material, tuple[Colour, ...]] = {
    Material.BRICK: (
        (0.62, 0.33, 0.26),
        (0.55, 0.40, 0.32),
        (0.70, 0.52, 0.40),
        (0.45, 0.30, 0.27),
        (0.74, 0.66, 0.55),
    ),
    Material.PLASTER: (
        (0.86, 0.80, 0.66),
        (0.80, 0.60, 0.45),
        (0.66, 0.72, 0.74),
        (0.88, 0.86, 0.82),
        (0.62, 0.70, 0.58),
        (0.85, 0.72, 0.70),
    ),
    Material.PANEL: ((0.66, 0.64, 0.60), (0.52, 0.53, 0.55), (0.76, 0.70, 0.60)),
}
FRAMES: tuple[Colour, ...] = ((0.90, 0.90, 0.88), (0.25, 0.22, 0.20), (0.32, 0.20, 0.13), (0.25, 0.36, 0.30))
_SINK_M = 1.5


@dataclass(frozen=True)
class _Front:
    """Openings of one façade: [N] left, right, bottom, top edges, and what surrounds them."""

    left: Float64
    right: Float64
    bottom: Float64
    top: Float64
    cell_left: Float64
    cell_right: Float64
    cell_bottom: Float64
    cell_top: Float64


def building(rng: np.random.Generator, width: float, height: float, depth: float) -> Mesh:
    """One building of about ``height`` (whole floors)."""
    wall = (Material.BRICK, Material.PLASTER, Material.PANEL)[rng.choice(3, p=(0.42, 0.38, 0.2))]
    tones = WALLS[wall]
    tone = np.clip(np.array(tones[rng.integers(len(tones))]) * rng.uniform(0.85, 1.1), 0, 0.95)
    frame = FRAMES[rng.integers(len(FRAMES))]
    trim = np.clip(tone * rng.choice([0.72, 1.2]), 0, 0.95)
    free = (0.0, 0.0, rng.uniform(0, 100), 0.0)
    ground, storey = rng.uniform(3.5, 4.3), rng.uniform(2.85, 3.3)
    floors = max(1, round((height - ground) / storey))
    top = ground + floors * storey
    bays = max(2, round(width / rng.uniform(2.3, 3.4)))
    bay = width / bays

    parts = [_upper_floors(rng, bays, bay, ground, storey, floors, wall, tone, free, frame, trim)]
    parts.append(_ground_floor(rng, bays, bay, ground, wall, tone, free, frame))
    parts.append(_shell(width, depth, top, wall, tone, free))
    eave = rng.uniform(0.15, 0.5)
    parts.append(
        masonry((-0.05, -eave, top - 0.1), (width + 0.05, 0.3, top + rng.uniform(0.25, 0.8)), wall, trim, free)
    )
    parts.append(masonry((0, -0.1, ground - 0.18), (width, 0.05, ground + 0.05), Material.PLASTER, trim, free))
    count = int(rng.integers(0, 4))
    at = np.stack(
        [rng.uniform(1, width - 2, count), rng.uniform(1, max(1.5, depth - 3), count), np.full(count, top)], 1
    )
    if count:
        parts.append(masonry(at, np.add(at, [1.1, 1.1, 1.9]), Material.BRICK, (0.5, 0.35, 0.3)))
    return joined(parts)


def _shell(width: float, depth: float, top: float, wall: int, tone: Float64, free: tuple[float, ...]) -> Mesh:
    """Side walls, back and roof."""
    z = (-_SINK_M, top)
    corner = lambda x, y, h: [x, y, h]  # noqa: E731
    walls, tex = [], []
    for (x0, y0), (x1, y1) in (((0, 0), (0, depth)), ((width, 0), (width, depth)), ((0, depth), (width, depth))):
        walls.append([corner(x0, y0, z[0]), corner(x1, y1, z[0]), corner(x1, y1, z[1]), corner(x0, y0, z[1])])
        run = float(np.hypot(x1 - x0, y1 - y0))
        tex.append([[0, z[0], 0], [run, z[0], 0], [run, z[1], 0], [0, z[1], 0]])
    roof = [[[0, 0, top], [width, 0, top], [width, depth, top], [0, depth, top]]]
    return joined([quads(walls, tex, wall, tone * 0.92, free), quads(roof, None, Material.ROOF, (0.35, 0.33, 0.32))])


def _openings(bays: int, bay: float, floors: int, base: float, storey: float, sizes: Float64) -> _Front:
    """A regular grid of openings; ``sizes``: width share, sill height share, lintel height share."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(bays), np.arange(floors)))
    left, bottom = np.asarray(i * bay, np.float64), np.asarray(base + j * storey, np.float64)
    half = bay * sizes[0] / 2
    return _Front(
        left + bay / 2 - half,
        left + bay / 2 + half,
        bottom + storey * sizes[1],
        bottom + storey * sizes[2],
        left,
        left + bay,
        bottom,
        bottom + storey,
    )


def _rectangle(x0: Float64, x1: Float64, z0: Float64, z1: Float64, y: float) -> Float64:
    """[N, 4, 3] upright rectangles at depth ``y``."""
    depth = np.full_like(x0, y)
    pairs = ((x0, z0), (x1, z0), (x1, z1), (x0, z1))
    return np.stack([np.stack([x, depth, z], -1) for x, z in pairs], 1)


def _wall_around(f: _Front, wall: int, tone: Float64, free: tuple[float, ...], recess: float) -> Mesh:
    """The wall of each cell around its opening, and the reveals."""
    flat = np.concatenate(
        [
            _rectangle(f.cell_left, f.left, f.cell_bottom, f.cell_top, 0),
            _rectangle(f.right, f.cell_right, f.cell_bottom, f.cell_top, 0),
            _rectangle(f.left, f.right, f.cell_bottom, f.bottom, 0),
            _rectangle(f.left, f.right, f.top, f.cell_top, 0),
        ]
    )
    edges = []
    for x0, z0, x1, z1 in (
        (f.left, f.bottom, f.left, f.top),
        (f.right, f.bottom, f.right, f.top),
        (f.left, f.bottom, f.right, f.bottom),
        (f.left, f.top, f.right, f.top),
    ):
        near, far = np.zeros_like(x0), np.full_like(x0, recess)
        ring = ((x0, near, z0), (x1, near, z1), (x1, far, z1), (x0, far, z0))
        edges.append(np.stack([np.stack(k, -1) for k in ring], 1))
    reveal = np.concatenate(edges)
    tex_flat = np.stack([flat[..., 0], flat[..., 2], np.zeros_like(flat[..., 0])], -1)
    tex_reveal = np.stack([reveal[..., 0], reveal[..., 2], reveal[..., 1]], -1)
    return joined([quads(flat, tex_flat, wall, tone, free), quads(reveal, tex_reveal, wall, tone * 0.95, free)])


def _panes(rng: np.random.Generator, f: _Front, material: int, frame: Colour, recess: float) -> Mesh:
    corners = _rectangle(f.left, f.right, f.bottom, f.top, recess)
    tex = corners - corners[:, :1]
    tex = np.stack([tex[..., 0], tex[..., 2], np.zeros_like(tex[..., 0])], -1)
    bars = rng.choice([0.2, 0.5, 0.9])
    n = len(f.left)
    free = np.stack([f.right - f.left, f.top - f.bottom, rng.random(n), np.full(n, bars)], 1)
    return quads(corners, tex, material, frame, free)


def _upper_floors(
    rng: np.random.Generator,
    bays: int,
    bay: float,
    base: float,
    storey: float,
    floors: int,
    wall: int,
    tone: Float64,
    free: tuple[float, ...],
    frame: Colour,
    trim: Float64,
) -> Mesh:
    recess = float(rng.uniform(0.10, 0.30))
    sizes = np.array([rng.uniform(0.38, 0.66), rng.uniform(0.2, 0.32), rng.uniform(0.76, 0.88)])
    f = _openings(bays, bay, floors, base, storey, sizes)
    parts = [_wall_around(f, wall, tone, free, recess), _panes(rng, f, Material.WINDOW, frame, recess)]
    low = np.stack([f.left - 0.1, np.full_like(f.left, -0.12), f.bottom - 0.1], 1)
    high = np.stack([f.right + 0.1, np.full_like(f.left, 0.05), f.bottom], 1)
    parts.append(masonry(low, high, Material.PLASTER, trim))
    if rng.random() < 0.4:
        low = np.stack([f.left - 0.12, np.full_like(f.left, -0.06), f.top], 1)
        high = np.stack([f.right + 0.12, np.full_like(f.left, 0.05), f.top + 0.22], 1)
        parts.append(masonry(low, high, Material.PLASTER, trim))
    if rng.random() < 0.4:
        with_balcony = np.isin(np.arange(len(f.left)) % bays, rng.choice(bays, max(1, bays // 3), replace=False))
        parts.append(_balconies(f, with_balcony))
    return joined(parts)


def _balconies(f: _Front, pick: NDArray[np.bool_]) -> Mesh:
    """A slab and a railing of bars."""
    left, right, floor = f.left[pick] - 0.25, f.right[pick] + 0.25, f.cell_bottom[pick] + 0.05
    n = len(left)
    y = lambda v: np.full(n, v)  # noqa: E731
    slab = masonry(
        np.stack([left, y(-0.95), floor], 1), np.stack([right, y(0), floor + 0.14], 1), Material.PLASTER, (0.6,) * 3
    )
    rail = masonry(
        np.stack([left, y(-0.95), floor + 1.0], 1),
        np.stack([right, y(-0.90), floor + 1.06], 1),
        Material.METAL,
        (0.15,) * 3,
    )
    share = np.linspace(0, 1, 8)
    x = (left[:, None] + (right - left)[:, None] * share).ravel()
    z = floor.repeat(8)
    bars = masonry(
        np.stack([x - 0.015, np.full_like(x, -0.94), z], 1),
        np.stack([x + 0.015, np.full_like(x, -0.91), z + 1.0], 1),
        Material.METAL,
        (0.15,) * 3,
    )
    return joined([slab, rail, bars])


def _ground_floor(
    rng: np.random.Generator,
    bays: int,
    bay: float,
    height: float,
    wall: int,
    tone: Float64,
    free: tuple[float, ...],
    frame: Colour,
) -> Mesh:
    shops = rng.random() < 0.5
    sizes = np.array([0.84, 0.1, 0.74] if shops else [rng.uniform(0.36, 0.5), 0.3, 0.78])
    f = _openings(bays, bay, 1, 0.0, height, sizes)
    door = int(rng.integers(bays))
    f.bottom[door] = 0.1
    parts = [_wall_around(f, wall, tone * (0.8 if shops else 0.95), free, 0.2)]
    keep = np.arange(bays) != door
    rest = _Front(**{k: v[keep] for k, v in vars(f).items()})
    parts.append(_panes(rng, rest, Material.SHOP if shops else Material.WINDOW, frame, 0.2))
    leaf = _rectangle(f.left[[door]], f.right[[door]], f.bottom[[door]], f.top[[door]], 0.2)
    parts.append(quads(leaf, None, Material.WOOD, rng.uniform(0.12, 0.55, 3)))
    base = masonry((0, -0.04, -_SINK_M), (bays * bay, 0.0, 0.35), Material.PANEL, tone * 0.6)
    step = masonry((f.left[door] - 0.1, -0.4, -0.2), (f.right[door] + 0.1, 0, 0.24), Material.KERB, (0.6, 0.6, 0.6))
    parts += [base, step]
    if shops:
        parts += _shop_fittings(rng, rest, height)
    return joined(parts)


def _shop_fittings(rng: np.random.Generator, f: _Front, height: float) -> list[Mesh]:
    """A lettered band above, and awnings over some bays."""
    n = len(f.left)
    band = rng.uniform(0.1, 0.8, 3)
    low = np.stack([f.left, np.full(n, -0.08), f.top + 0.08], 1)
    high = np.stack([f.right, np.zeros(n), np.full(n, height - 0.2)], 1)
    parts = [masonry(low, high, Material.PLAIN, band)]
    marks = rng.random((n, 9)) < 0.75
    i, j = np.nonzero(marks)
    pitch = (f.right - f.left) / 11
    x = f.left[i] + pitch[i] * (j + 1.2)
    z = (f.top + 0.08 + height - 0.2)[i] / 2
    tall = rng.uniform(0.07, 0.14, len(i))
    parts.append(
        masonry(
            np.stack([x, np.full(len(i), -0.12), z - tall], 1),
            np.stack([x + pitch[i] * 0.6, np.full(len(i), -0.08), z + tall], 1),
            Material.PLAIN,
            1.0 - band,
        )
    )
    pick = rng.random(n) < 0.5
    if pick.any():
        a, b, t = f.left[pick], f.right[pick], f.top[pick]
        reach = np.full_like(a, -1.1)
        ring = ((a, 0 * a, t + 0.1), (b, 0 * a, t + 0.1), (b, reach, t - 0.5), (a, reach, t - 0.5))
        corners = np.stack([np.stack(k, -1) for k in ring], 1)
        parts.append(quads(corners, None, Material.AWNING, rng.uniform(0.1, 0.7, 3)))
    return parts
