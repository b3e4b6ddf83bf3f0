"""Cars: shapes and their meshes, in the frame of an actor (x forward, y left, z up, origin on the ground)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import (
    SIDES,
    Mesh,
    Surface,
    box_mesh,
    ellipsoid_mesh,
    grid_quads,
    join_meshes,
    quad_mesh,
    triangle_mesh,
    tube_mesh,
)

# Mostly greys and dark colours, as in traffic.
_PAINT_COLOURS = (
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
_WHEEL_RADIUS_M = 0.32
_MIRRORS_M = 0.1


@dataclass(frozen=True)
class CarShape:
    """Where a car's profile bends.

    Attributes:
        length: metres.
        width: of the body without mirrors, metres.
        height: metres.
        bonnet: height of the bonnet, metres.
        waist: height of the windows' lower edge, metres.
        windscreen: x of its foot and of its head, as shares of the length; 0 is the middle.
        rear: the same of the rear window.
    """

    length: float
    width: float
    height: float
    bonnet: float
    waist: float
    windscreen: tuple[float, float]
    rear: tuple[float, float]

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Length, width with mirrors, and height of the car's box."""
        return (self.length, self.width + _MIRRORS_M, self.height)


@dataclass(frozen=True)
class _Kind:
    """Means of one kind of car; see ``CarShape``."""

    length: float
    height: float
    bonnet: float
    windscreen: tuple[float, float]
    rear: tuple[float, float]


_HATCHBACK = _Kind(4.0, 1.46, 0.78, windscreen=(0.20, 0.06), rear=(-0.47, -0.38))
_SALOON = _Kind(4.6, 1.43, 0.78, windscreen=(0.20, 0.05), rear=(-0.38, -0.22))
_ESTATE = _Kind(4.7, 1.5, 0.78, windscreen=(0.20, 0.05), rear=(-0.48, -0.42))
_VAN = _Kind(4.9, 1.85, 0.88, windscreen=(0.34, 0.24), rear=(-0.49, -0.47))
_KINDS = (_HATCHBACK, _SALOON, _ESTATE, _VAN)
_KIND_SHARES = (0.35, 0.3, 0.2, 0.15)


def draw_car_shape(rng: np.random.Generator) -> CarShape:
    """Draws a hatchback, a saloon, an estate or a van; none is much higher than the ego vehicle's cameras.

    Args:
        rng: draws kind and sizes.

    Returns:
        The shape.
    """
    kind = _KINDS[rng.choice(len(_KINDS), p=_KIND_SHARES)]
    length = kind.length + rng.uniform(-0.15, 0.2)
    height = kind.height + rng.uniform(-0.04, 0.05)
    width = 1.8 + rng.uniform(-0.06, 0.1)
    return CarShape(
        length=length,
        width=width,
        height=height,
        bonnet=kind.bonnet,
        waist=0.93,
        windscreen=kind.windscreen,
        rear=kind.rear,
    )


def build_car(rng: np.random.Generator, shape: CarShape) -> Mesh:
    """Builds body, cabin with glass, wheels, lamps, mirrors and plates; about 500 triangles.

    Args:
        rng: draws the paint.
        shape: of the car.

    Returns:
        The car.
    """
    # The order of the draws is the car: colour, then dust.
    colour = np.array(_PAINT_COLOURS[rng.integers(len(_PAINT_COLOURS))])
    paint = Surface(Material.PAINT, colour, (0.0, 0.0, rng.uniform(0, 50), 0.0))
    front = shape.length / 2
    back = -shape.length / 2
    parts = [_build_body(shape, paint), _build_cabin(shape, paint)]
    axle = shape.length * 0.30
    for x in (axle, -axle):
        for side in SIDES:
            parts += _build_wheel(shape, x, side)
    for side in SIDES:
        parts += _build_lamps_and_mirror(shape, side, paint)
    for x, tone in ((front, (0.9, 0.9, 0.88)), (back, (0.88, 0.85, 0.6))):
        plate = Surface(Material.PLAIN, tone)
        parts.append(box_mesh((x - 0.03, -0.26, 0.42), (x + 0.03, 0.26, 0.53), plate))
    grille = Surface(Material.PLAIN, (0.06,) * 3)
    parts.append(box_mesh((front - 0.05, -0.45, 0.3), (front + 0.012, 0.45, 0.4), grille))
    return join_meshes(parts)


def _build_wheel(shape: CarShape, x: float, side: int) -> list[Mesh]:
    """A wheel and the dark housing around it."""
    half = shape.width / 2
    radius = _WHEEL_RADIUS_M
    path = [[x, side * (half - 0.22), radius], [x, side * (half + 0.015), radius]]
    rubber = Surface(Material.TYRE, (0.1,) * 3, (radius, x, radius, 0))
    tube = tube_mesh(path, [radius, radius], 16, rubber)
    # Texture of a wheel is its own x and z, so that the rim is drawn on the cap.
    wheel = triangle_mesh(tube.vertices, None, rubber)
    # The hub of its texture is far away, so that no rim is drawn on it.
    housing = Surface(Material.TYRE, (0.02,) * 3, (9.0, -99, 0, 0))
    hub = (x, side * (half - 0.2), radius)
    return [wheel, ellipsoid_mesh(hub, (0.39, 0.211, 0.37), housing)]


def _build_lamps_and_mirror(shape: CarShape, side: int, paint: Surface) -> list[Mesh]:
    half = shape.width / 2
    front = shape.length / 2
    back = -shape.length / 2
    y = side * (half - 0.32)
    headlamp = Surface(Material.LAMP, (0.88, 0.88, 0.84))
    tail_lamp = Surface(Material.LAMP, (0.62, 0.05, 0.05))
    mirror = (shape.length * shape.windscreen[0] - 0.35, side * (half + 0.06), 0.98)
    return [
        box_mesh((front - 0.1, y - 0.2, 0.58), (front + 0.02, y + 0.2, 0.72), headlamp),
        box_mesh((back - 0.02, y - 0.18, 0.66), (back + 0.1, y + 0.18, 0.84), tail_lamp),
        ellipsoid_mesh(mirror, (0.09, 0.1, 0.07), paint, level=0),
    ]


def _build_body(shape: CarShape, paint: Surface) -> Mesh:
    """The lower body: cross-sections of eight corners swept along x."""
    x = np.array([-0.5, -0.485, -0.40, -0.2, 0.1, 0.25, 0.42, 0.48, 0.5]) * shape.length
    # Cars with a steep rear have no boot lid below the window.
    boot = shape.waist if shape.rear[0] < -0.45 else shape.waist - 0.04
    top = np.array([0.6, boot - 0.08, boot, shape.waist, shape.waist, shape.bonnet + 0.12, shape.bonnet, 0.62, 0.52])
    # In at both ends, widest along the doors.
    half_width = np.array([0.88, 0.95, 1.0, 1.0, 1.0, 1.0, 0.97, 0.90, 0.82]) * shape.width / 2
    bottom = np.array([0.36, 0.28, 0.22, 0.2, 0.2, 0.2, 0.22, 0.27, 0.32])
    # Four corners a side: sill, skirt, shoulder, waist.
    heights = (bottom, bottom + 0.1, 0.45 * bottom + 0.55 * top, top)
    bulge = (0.86, 0.97, 1.0, 0.93)
    ring = []
    for side in SIDES:
        # Up on the left, down on the right.
        order = range(4) if side > 0 else range(3, -1, -1)
        ring += [np.stack([x, side * half_width * bulge[k], heights[k]], 1) for k in order]
    grid = np.stack([*ring, ring[0]], 1)
    skin = quad_mesh(grid_quads(grid), None, paint)
    ends = []
    for k in (0, len(x) - 1):
        centre = grid[k, :8].mean(0)
        ends.append(np.stack([np.broadcast_to(centre, (8, 3)), grid[k, :-1], grid[k, 1:]], 1))
    return join_meshes([skin, triangle_mesh(np.concatenate(ends), None, paint)])


def _build_cabin(shape: CarShape, paint: Surface) -> Mesh:
    """Roof of paint, glass around, pillars."""
    # The cabin leans inwards from the waist to the roof.
    foot_y = shape.width / 2 * 0.93
    head_y = shape.width / 2 * 0.74
    foot_z = shape.waist - 0.02
    head_z = shape.height - 0.03
    rear_foot, rear_head = (share * shape.length for share in shape.rear)
    front_foot, front_head = (share * shape.length for share in shape.windscreen)
    foot = {s: [[rear_foot, s * foot_y, foot_z], [front_foot, s * foot_y, foot_z]] for s in SIDES}
    head = {s: [[rear_head, s * head_y, head_z], [front_head, s * head_y, head_z]] for s in SIDES}
    screen = [foot[1][1], foot[-1][1], head[-1][1], head[1][1]]
    rear = [foot[1][0], foot[-1][0], head[-1][0], head[1][0]]
    sides = [[foot[s][0], foot[s][1], head[s][1], head[s][0]] for s in SIDES]
    glass = quad_mesh([screen, rear, *sides], None, Surface(Material.CAR_GLASS, (0.10, 0.12, 0.13)))
    middle_x = (rear_head + front_head) / 2
    roof_centre = [middle_x, 0.0, shape.height]
    rim = [head[1][0], head[1][1], head[-1][1], head[-1][0]]
    roof = triangle_mesh([[rim[k], rim[(k + 1) % 4], roof_centre] for k in range(4)], None, paint)
    pillars = []
    for s in SIDES:
        front_pillar = (foot[s][1], head[s][1])
        rear_pillar = (foot[s][0], head[s][0])
        middle_pillar = ([middle_x, s * foot_y, foot_z], [middle_x, s * head_y, head_z])
        roof_rail = (head[s][0], head[s][1])
        for path in (front_pillar, rear_pillar, middle_pillar, roof_rail):
            # A centimetre outside the glass, or the two would flicker.
            pillars.append(tube_mesh(np.add(path, [0, s * 0.01, 0]), [0.045, 0.04], 5, paint))
    return join_meshes([glass, roof, *pillars])
