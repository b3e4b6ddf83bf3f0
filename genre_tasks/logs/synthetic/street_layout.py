"""Lays the street out: what stands where, and who moves how. Everything follows from the seed, subject by subject."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from genre_tasks.logs.synthetic import furniture
from genre_tasks.logs.synthetic.buildings import build_building
from genre_tasks.logs.synthetic.cars import build_car, draw_car_shape
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, EgoDrive
from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import SIDES, Mesh, Surface, join_meshes, wall_mesh
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.road import KERB_HEIGHT_M, Road, make_generator, road_mesh
from genre_tasks.logs.synthetic.street_actors import Actor
from genre_tasks.logs.synthetic.traffic import drive_cars, walk_pedestrians
from genre_tasks.logs.types import Float64

# The front camera has a longer lens than the back camera, and looks further.
_BEHIND_M = 70.0
_AHEAD_M = 130.0
# No parking on a zebra crossing, nor where a driver must see who waits at it.
_CROSSING_CLEARANCE_M = 5.5


@dataclass(frozen=True)
class ParkedCar:
    """A car that stands; its mesh is part of what is static.

    Attributes:
        name: unique in the log; the track's id.
        street_SE3_actor: [4, 4], origin at the middle of its footprint.
        size_m: length, width, height of its box.
        label: class of its annotation.
    """

    name: str
    street_SE3_actor: Float64
    size_m: tuple[float, float, float]
    label: str = "Car"


@dataclass(frozen=True)
class StreetLayout:
    """All geometry, in the street's own coordinates (no world offset).

    Attributes:
        static: everything that stands, parked cars included.
        parked: the parked cars, to annotate them.
        actors: what may move.
    """

    static: Mesh
    parked: tuple[ParkedCar, ...]
    actors: tuple[Actor, ...]


@dataclass(frozen=True)
class _Extent:
    """A stretch of the street to fill.

    Attributes:
        seed: of the street.
        road: its curve and cross-section.
        start: s at which the stretch begins, metres.
        end: s at which it ends.
    """

    seed: int
    road: Road
    start: float
    end: float


def build_layout(parameters: StreetParameters, road: Road, ego: EgoDrive) -> StreetLayout:
    """Builds the street of a seed, as long as the drive needs.

    Args:
        parameters: of the street.
        road: its curve and cross-section.
        ego: how the ego vehicle drives.

    Returns:
        The street.
    """
    distance = float(ego.distance(np.array([parameters.frames * FRAME_S]))[0])
    extent = _Extent(parameters.seed, road, start=-_BEHIND_M, end=distance + _AHEAD_M)
    # Subjects have random streams of their own, so this order is free; that of the meshes below numbers the faces.
    parked, car_meshes = _park_cars(extent)
    parts = [road_mesh(road, extent.start - 15, extent.end + 15)]
    parts += _line_up_buildings(extent)
    parts += _close_ends(extent)
    parts += _furnish_pavements(extent)
    actors = (*drive_cars(parameters, road, ego), *walk_pedestrians(parameters, road, ego))
    return StreetLayout(join_meshes([*parts, *car_meshes]), tuple(parked), actors)


def _line_up_buildings(extent: _Extent) -> Iterator[Mesh]:
    """A row of houses on either side, some with gardens between them."""
    road = extent.road
    for side in SIDES:
        rng = make_generator(extent.seed, f"buildings {side}")
        typical_height = rng.uniform(9, 19)
        s = extent.start - rng.uniform(0, 8)
        while s < extent.end:
            width = rng.uniform(8, 21)
            depth = rng.uniform(9, 14)
            # Houses of one side are of similar height, as in a street that was built at one time.
            height = float(np.clip(typical_height * rng.uniform(0.6, 1.5), 5, 32))
            # Half of the houses stand on the building line.
            setback = rng.choice([0.0, 0.0, 0.4, 1.2])
            gap = rng.uniform(3, 9) if rng.random() < 0.22 else 0.0
            mesh = build_building(rng, width, height, depth)
            t = road.section.front(side) + side * setback
            # A building's x runs along the street on the left and against it on the right.
            corner = s if side > 0 else s + width
            turn = 0.0 if side > 0 else np.pi
            yaw = float(road.heading(s + width / 2) - road.heading(corner)) + turn
            yield mesh.transformed(road.upright_pose(corner, t, KERB_HEIGHT_M, yaw))
            if gap:
                filler_pose = road.upright_pose(s + width, t + side * 0.6, KERB_HEIGHT_M)
                yield _build_gap_filler(rng, gap).transformed(filler_pose)
            s += width + gap


def _build_gap_filler(rng: np.random.Generator, gap: float) -> Mesh:
    """A garden wall or a hedge between two houses."""
    if rng.random() < 0.5:
        return furniture.build_hedge(rng, gap)
    height = rng.uniform(1.0, 2.2)
    return wall_mesh((0, -0.15, -1), (gap, 0.15, height), Surface(Material.BRICK, (0.6, 0.45, 0.36)))


def _close_ends(extent: _Extent) -> Iterator[Mesh]:
    """Houses that close the view at both ends, and taller blocks behind the first row."""
    rng = make_generator(extent.seed, "ends")
    for s, yaw in ((extent.end + 8, -np.pi / 2), (extent.start - 8, np.pi / 2)):
        for k in range(-2, 3):
            mesh = build_building(rng, 17.0, rng.uniform(9, 22), 10.0)
            t = k * 17 + (8.5 if yaw < 0 else -8.5)
            yield mesh.transformed(extent.road.upright_pose(s, t, 0.0, yaw))
    yield from _raise_background(rng, extent)


def _raise_background(rng: np.random.Generator, extent: _Extent) -> Iterator[Mesh]:
    """Plain blocks that show above and between the houses."""
    for side in SIDES:
        s = extent.start
        while s < extent.end:
            width = rng.uniform(14, 30)
            height = rng.uniform(14, 38)
            t = extent.road.section.front(side) + side * rng.uniform(24, 45)
            tone = rng.uniform(0.35, 0.7, 3)
            surface = Surface(Material.PANEL, tone, (0, 0, rng.uniform(0, 50), 0))
            block = wall_mesh((0, 0, -3), (width, 12, height), surface)
            corner = s if side > 0 else s + width
            yield block.transformed(extent.road.upright_pose(corner, t, 0, 0 if side > 0 else np.pi))
            s += width + rng.uniform(4, 30)


def _furnish_pavements(extent: _Extent) -> Iterator[Mesh]:
    """Trees, lamps and small things along both kerbs."""
    for side in SIDES:
        rng = make_generator(extent.seed, f"pavement {side}")
        yield from _plant_trees(rng, extent, side)
        yield from _place_lamps(rng, extent, side)
        yield from _place_small_things(rng, extent, side)


def _plant_trees(rng: np.random.Generator, extent: _Extent, side: int) -> Iterator[Mesh]:
    # A long street (a log of over 60 frames or so) has thinner trees, which keeps it under 300 000 triangles.
    leaf_share = min(1.0, 260.0 / (extent.end - extent.start))
    spacing = rng.uniform(8, 20)
    has_trees = rng.random() < 0.8
    typical_height = rng.uniform(5.5, 9.0)
    t = extent.road.section.kerb(side) + side * 0.95
    s = extent.start
    while s < extent.end:
        s += spacing * rng.uniform(0.7, 1.3)
        if has_trees and rng.random() < 0.85:
            height = typical_height * rng.uniform(0.8, 1.2)
            leaves = int(rng.integers(900, 1500) * leaf_share)
            mesh = furniture.build_tree(rng, height, leaves)
            yield mesh.transformed(extent.road.upright_pose(s, t, KERB_HEIGHT_M, rng.uniform(0, 6.28)))


def _place_lamps(rng: np.random.Generator, extent: _Extent, side: int) -> Iterator[Mesh]:
    t = extent.road.section.kerb(side) + side * 0.55
    first = extent.start + rng.uniform(0, 20)
    for s in np.arange(first, extent.end, rng.uniform(22, 34)):
        mesh = furniture.build_lamp(rng, rng.uniform(5.5, 7))
        yield mesh.transformed(extent.road.upright_pose(s, t, KERB_HEIGHT_M, _yaw_to_street(side)))


def _place_small_things(rng: np.random.Generator, extent: _Extent, side: int) -> Iterator[Mesh]:
    """Signs, bins, benches and rows of bollards."""
    road = extent.road
    kerb = road.section.kerb(side)
    # What is built, and how far behind the kerb; signs are twice as frequent.
    things = (
        (furniture.build_sign, 0.5),
        (furniture.build_bin, 0.6),
        (furniture.build_bench, 1.2),
        (furniture.build_sign, 0.5),
    )
    s = extent.start
    while s < extent.end:
        s += rng.uniform(3, 13)
        kind = rng.integers(len(things) + 1)
        if kind == len(things):
            for k in range(4):
                pose = road.upright_pose(s + 1.4 * k, kerb + side * 0.5, KERB_HEIGHT_M, 0)
                yield furniture.build_bollard(rng).transformed(pose)
            s += 5
            continue
        build, distance = things[kind]
        mesh = build(rng)
        yaw = _yaw_to_street(side) + rng.uniform(-0.1, 0.1)
        yield mesh.transformed(road.upright_pose(s, kerb + side * distance, KERB_HEIGHT_M, yaw))


def _yaw_to_street(side: int) -> float:
    """Turns things that look along their y so that they look at the street, from its side."""
    return 0.0 if side < 0 else np.pi


def _park_cars(extent: _Extent) -> tuple[list[ParkedCar], list[Mesh]]:
    """Parked cars along both kerbs, but not on crossings, and their meshes."""
    road = extent.road
    parked: list[ParkedCar] = []
    meshes: list[Mesh] = []
    for side in SIDES:
        rng = make_generator(extent.seed, f"parked {side}")
        density = rng.uniform(0.35, 0.9)
        s = extent.start + rng.uniform(0, 5)
        while s < extent.end:
            # Everything is drawn whether or not the car stays, so that crossings do not change the cars behind them.
            shape = draw_car_shape(rng)
            mesh = build_car(rng, shape)
            is_drawn = rng.random() < density
            aside = rng.uniform(-0.08, 0.08)
            skew = rng.normal(0, 0.015)
            turn = np.pi if rng.random() < 0.12 else 0.0
            if is_drawn and np.abs(road.crossings - s).min() > _CROSSING_CLEARANCE_M:
                t = road.section.kerb(side) - side * (0.25 + shape.width / 2 + aside)
                pose = road.pose(s, t, 0.0, skew + turn + (np.pi if side > 0 else 0.0))
                name = f"parked-{'left' if side > 0 else 'right'}-{len(parked)}"
                parked.append(ParkedCar(name, pose, shape.size_m))
                meshes.append(mesh.transformed(pose))
            s += shape.length + rng.uniform(0.7, 2.2)
    return parked, meshes
