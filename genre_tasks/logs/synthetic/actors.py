"""Cars and pedestrians: their meshes and how they move.

An actor's frame has its origin at the middle of its footprint on the ground: x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, boxes, ellipsoid, joined, quads, soup, tube
from genre_tasks.logs.types import Float64

PoseAt = Callable[[Any], Float64]

CAR_COLOURS = (
    (0.75, 0.76, 0.78),
    (0.08, 0.08, 0.09),
    (0.88, 0.88, 0.87),
    (0.55, 0.08, 0.08),
    (0.10, 0.18, 0.42),
    (0.35, 0.37, 0.40),
    (0.20, 0.33, 0.25),
    (0.72, 0.60, 0.38),
    (0.85, 0.45, 0.10),
)


@dataclass(frozen=True)
class Part:
    """A rigid piece of an actor and where it is in the actor's frame at a time ([n] seconds → [n, 4, 4])."""

    mesh: Mesh
    actor_SE3_part: PoseAt | None = None


@dataclass(frozen=True)
class Actor:
    """Something annotated. ``world_SE3_actor`` ([n] seconds → [n, 4, 4]) in the street's own world coordinates."""

    name: str
    label: str
    parts: tuple[Part, ...]
    size_m: tuple[float, float, float]
    world_SE3_actor: PoseAt


@dataclass(frozen=True)
class CarShape:
    """Stations of a car's profile as shares of its length, and heights in metres."""

    length: float
    width: float
    height: float
    bonnet: float
    waist: float
    windscreen: tuple[float, float]
    rear: tuple[float, float]


def draw_shape(rng: np.random.Generator) -> CarShape:
    """A hatchback, a saloon, an estate or a van; never higher than the ego's cameras by much."""
    kind = rng.choice(4, p=(0.35, 0.3, 0.2, 0.15))
    length = (4.0, 4.6, 4.7, 4.9)[kind] + rng.uniform(-0.15, 0.2)
    height = (1.46, 1.43, 1.5, 1.85)[kind] + rng.uniform(-0.04, 0.05)
    screen = ((0.20, 0.06), (0.20, 0.05), (0.20, 0.05), (0.34, 0.24))[kind]
    rear = ((-0.47, -0.38), (-0.38, -0.22), (-0.48, -0.42), (-0.49, -0.47))[kind]
    return CarShape(length, 1.8 + rng.uniform(-0.06, 0.1), height, 0.78 + 0.1 * (kind == 3), 0.93, screen, rear)


def car(rng: np.random.Generator, shape: CarShape) -> Mesh:
    """Body, cabin with glass, wheels, lamps, mirrors and plates; about 500 triangles."""
    colour = np.array(CAR_COLOURS[rng.integers(len(CAR_COLOURS))])
    half = shape.width / 2
    free = (0.0, 0.0, rng.uniform(0, 50), 0.0)
    parts = [_body(shape, colour, free), _cabin(shape, colour, free)]
    radius, axle = 0.32, shape.length * 0.30
    for x in (axle, -axle):
        for side in (1, -1):
            hub = (x, side * (half - 0.2), radius)
            path = [[x, side * (half - 0.22), radius], [x, side * (half + 0.015), radius]]
            wheel = tube(path, [radius, radius], 16, Material.TYRE, (0.1,) * 3, (radius, x, radius, 0))
            # Texture of a wheel is its own x and z, so that the rim is drawn on the cap.
            parts.append(soup(wheel.vertices, None, Material.TYRE, (0.1,) * 3, wheel.parameters))
            parts.append(ellipsoid(hub, (0.39, 0.211, 0.37), Material.TYRE, (0.02,) * 3, (9.0, -99, 0, 0), level=1))
    front, back = shape.length / 2, -shape.length / 2
    for side in (1, -1):
        y = side * (half - 0.32)
        parts.append(
            boxes((front - 0.1, y - 0.2, 0.58), (front + 0.02, y + 0.2, 0.72), Material.LAMP, (0.88, 0.88, 0.84))
        )
        parts.append(
            boxes((back - 0.02, y - 0.18, 0.66), (back + 0.1, y + 0.18, 0.84), Material.LAMP, (0.62, 0.05, 0.05))
        )
        m = (shape.length * shape.windscreen[0] - 0.35, side * (half + 0.06), 0.98)
        parts.append(ellipsoid(m, (0.09, 0.1, 0.07), Material.PAINT, colour, free, level=0))
    for x, tone in ((front, (0.9, 0.9, 0.88)), (back, (0.88, 0.85, 0.6))):
        parts.append(boxes((x - 0.03, -0.26, 0.42), (x + 0.03, 0.26, 0.53), Material.PLAIN, tone))
    parts.append(boxes((front - 0.05, -0.45, 0.3), (front + 0.012, 0.45, 0.4), Material.PLAIN, (0.06,) * 3))
    return joined(parts)


def _body(shape: CarShape, colour: Float64, free: tuple[float, ...]) -> Mesh:
    """The lower body: cross-sections of eight corners swept along x."""
    x = np.array([-0.5, -0.485, -0.40, -0.2, 0.1, 0.25, 0.42, 0.48, 0.5]) * shape.length
    boot = shape.waist if shape.rear[0] < -0.45 else shape.waist - 0.04
    top = np.array([0.6, boot - 0.08, boot, shape.waist, shape.waist, shape.bonnet + 0.12, shape.bonnet, 0.62, 0.52])
    wide = np.array([0.88, 0.95, 1.0, 1.0, 1.0, 1.0, 0.97, 0.90, 0.82]) * shape.width / 2
    low = np.array([0.36, 0.28, 0.22, 0.2, 0.2, 0.2, 0.22, 0.27, 0.32])
    ring = []
    for side in (1, -1):
        ys = (0.86, 0.97, 1.0, 0.93)
        zs = (low, low + 0.1, 0.45 * low + 0.55 * top, top)
        order = range(4) if side > 0 else range(3, -1, -1)
        ring += [np.stack([x, side * wide * ys[k], zs[k]], 1) for k in order]
    grid = np.stack([*ring, ring[0]], 1)
    skin = quads(
        np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], 2), None, Material.PAINT, colour, free
    )
    ends = []
    for k in (0, len(x) - 1):
        centre = grid[k, :8].mean(0)
        ends.append(np.stack([np.broadcast_to(centre, (8, 3)), grid[k, :-1], grid[k, 1:]], 1))
    return joined([skin, soup(np.concatenate(ends), None, Material.PAINT, colour, free)])


def _cabin(shape: CarShape, colour: Float64, free: tuple[float, ...]) -> Mesh:
    """Roof of paint, glass around, pillars."""
    n, w, h = shape.length, shape.width / 2, shape.height
    base, roof = w * 0.93, w * 0.74
    xs = [shape.rear[0] * n, shape.rear[1] * n, shape.windscreen[1] * n, shape.windscreen[0] * n]
    z = shape.waist - 0.02
    foot = {s: [[xs[0], s * base, z], [xs[3], s * base, z]] for s in (1, -1)}
    head = {s: [[xs[1], s * roof, h - 0.03], [xs[2], s * roof, h - 0.03]] for s in (1, -1)}
    screen = [foot[1][1], foot[-1][1], head[-1][1], head[1][1]]
    rear = [foot[1][0], foot[-1][0], head[-1][0], head[1][0]]
    sides = [[foot[s][0], foot[s][1], head[s][1], head[s][0]] for s in (1, -1)]
    glass = quads([screen, rear, *sides], None, Material.CAR_GLASS, (0.10, 0.12, 0.13))
    mid = [(xs[1] + xs[2]) / 2, 0.0, h]
    ring = [head[1][0], head[1][1], head[-1][1], head[-1][0]]
    lid = soup([[ring[k], ring[(k + 1) % 4], mid] for k in range(4)], None, Material.PAINT, colour, free)
    posts = []
    for s in (1, -1):
        ends = [(foot[s][1], head[s][1]), (foot[s][0], head[s][0])]
        middle = (xs[1] + xs[2]) / 2
        ends.append(([middle, s * base, z], [middle, s * roof, h - 0.03]))
        ends.append((head[s][0], head[s][1]))
        posts += [tube(np.add(e, [0, s * 0.01, 0]), [0.045, 0.04], 5, Material.PAINT, colour, free) for e in ends]
    return joined([glass, lid, *posts])


def pedestrian(
    rng: np.random.Generator, pace: float, stride: float = 0.0
) -> tuple[tuple[Part, ...], tuple[float, float, float]]:
    """Torso with head and arms, and two legs that swing at walking ``pace`` (m/s; 0 stands still). Parts and size.

    ``stride``: arms swing against the legs, by so many times the legs' angle; beyond 1 the legs do too. At 0 the arms
    are part of the torso.
    """
    height = rng.uniform(1.55, 1.9)
    hip = height * 0.5
    coat, trousers = rng.uniform(0.08, 0.8, 3), rng.uniform(0.05, 0.45, 3)
    skin = np.array([0.80, 0.60, 0.48]) * rng.uniform(0.5, 1.1)
    cloth = (float(rng.random() < 0.4), 0.0, 0.0, 0.0)
    top = height * 0.84
    spine = [[0.0, 0.0, hip - 0.06], [0.0, 0.0, top - 0.16], [0.0, 0.0, top]]
    body = [
        tube(spine, [0.16, 0.21, 0.1], 10, Material.CLOTH, coat, cloth),
        ellipsoid((0.01, 0, height - 0.12), (0.1, 0.085, 0.12), Material.PLAIN, skin),
        ellipsoid((-0.02, 0, height - 0.075), (0.105, 0.095, 0.09), Material.PLAIN, rng.uniform(0.02, 0.4, 3)),
    ]
    limbs = []
    for side in (1, -1):
        if stride:
            shoulder = (0.02, side * 0.22, top - 0.05)
            path = [[0.0, 0.0, 0.0], [0.0, side * 0.06, hip - top + 0.05]]
            swing = _swing(-side * stride, shoulder, pace, height)
            limbs.append(Part(tube(path, [0.06, 0.045], 6, Material.CLOTH, coat, cloth), swing))
        else:
            path = [[0.02, side * 0.22, top - 0.05], [0.1 * side, side * 0.28, hip]]
            body.append(tube(path, [0.06, 0.045], 6, Material.CLOTH, coat, cloth))
    for side in (1, -1):
        path = [[0.0, 0.0, 0.02], [0.0, 0.0, -hip * 0.5], [0.0, 0.0, -hip + 0.06]]
        leg = joined(
            [
                tube(path, [0.09, 0.07, 0.05], 8, Material.CLOTH, trousers),
                boxes((-0.07, -0.045, -hip), (0.17, 0.045, -hip + 0.09), Material.PLAIN, (0.1, 0.08, 0.07)),
            ]
        )
        limbs.append(Part(leg, _swing(side * max(1.0, stride), (0.0, side * 0.09, hip), pace, height)))
    return (Part(joined(body)), *limbs), (0.75, 0.68, height)


def _swing(share: float, joint: tuple[float, float, float], pace: float, height: float) -> PoseAt:
    """About the axis to the left through a joint, by ``share`` of a leg's 24°, twice a pace to and fro."""

    def pose(times: Float64) -> Float64:
        angle = share * 0.42 * np.sin(2 * np.pi * pace / (0.85 * height) * times) if pace else np.zeros_like(times)
        out = np.zeros((len(times), 4, 4))
        c, s = np.cos(angle), np.sin(angle)
        out[:, 0, 0], out[:, 0, 2], out[:, 2, 0], out[:, 2, 2] = c, s, -s, c
        out[:, 1, 1] = out[:, 3, 3] = 1
        out[:, :3, 3] = joint
        return out

    return pose
