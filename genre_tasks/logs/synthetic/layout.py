"""Lays the street out: what stands where, who moves how. Everything follows from the seed, subject by subject."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from genre_tasks.logs.synthetic import furniture
from genre_tasks.logs.synthetic.actors import Actor, Part, PoseAt, car, draw_shape, pedestrian
from genre_tasks.logs.synthetic.buildings import building
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, Ego
from genre_tasks.logs.synthetic.materials import Material
from genre_tasks.logs.synthetic.mesh import Mesh, joined, masonry
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.road import KERB_HEIGHT_M, Road, generator, road_surfaces
from genre_tasks.logs.types import Float64

_BEHIND_M = 70.0
_AHEAD_M = 130.0
_GAP_M = 9.0


@dataclass(frozen=True)
class Parked:
    """A car that stands: its box frame (origin at the footprint's middle) and size."""

    name: str
    world_SE3_actor: Float64
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Layout:
    """All geometry, in the street's own coordinates (no world offset)."""

    static: Mesh
    parked: tuple[Parked, ...]
    actors: tuple[Actor, ...]


def lay_out(parameters: StreetParameters, road: Road, ego: Ego) -> Layout:
    """Builds the street of a seed, as long as the drive needs."""
    end = float(ego.travel(np.array([parameters.frames * FRAME_S]))[0]) + _AHEAD_M
    start, seed = -_BEHIND_M, parameters.seed
    parked, cars = _parked_cars(seed, road, start, end)
    parts = [road_surfaces(road, start - 15, end + 15)]
    parts += _buildings(seed, road, start, end)
    parts += _ends(seed, road, start, end)
    parts += _pavements(seed, road, start, end)
    actors = [*_moving_cars(parameters, road, ego), *_pedestrians(parameters, road, ego)]
    return Layout(joined([*parts, *cars]), tuple(parked), tuple(actors))


def _buildings(seed: int, road: Road, start: float, end: float) -> Iterator[Mesh]:
    for side in (1, -1):
        rng = generator(seed, f"buildings {side}")
        tall = rng.uniform(9, 19)
        s = start - rng.uniform(0, 8)
        while s < end:
            width, depth = rng.uniform(8, 21), rng.uniform(9, 14)
            height = float(np.clip(tall * rng.uniform(0.6, 1.5), 5, 32))
            setback = rng.choice([0.0, 0.0, 0.4, 1.2])
            gap = rng.uniform(3, 9) if rng.random() < 0.22 else 0.0
            mesh = building(rng, width, height, depth)
            t = road.section.front(side) + side * setback
            # The frame's x runs along the street on the left and against it on the right.
            corner = s if side > 0 else s + width
            yaw = float(road.heading(s + width / 2) - road.heading(corner))
            yield mesh.placed(road.upright(corner, t, KERB_HEIGHT_M, yaw + (0.0 if side > 0 else np.pi)))
            if gap:
                yield _gap_filler(rng, gap).placed(road.upright(s + width, t + side * 0.6, KERB_HEIGHT_M))
            s += width + gap


def _gap_filler(rng: np.random.Generator, gap: float) -> Mesh:
    """A garden wall or a hedge between two houses."""
    if rng.random() < 0.5:
        return furniture.hedge(rng, gap)
    return masonry((0, -0.15, -1), (gap, 0.15, rng.uniform(1.0, 2.2)), Material.BRICK, (0.6, 0.45, 0.36))


def _ends(seed: int, road: Road, start: float, end: float) -> Iterator[Mesh]:
    """Houses that close the view at both ends, and taller blocks behind the first row."""
    rng = generator(seed, "ends")
    for s, yaw in ((end + 8, -np.pi / 2), (start - 8, np.pi / 2)):
        for k in range(-2, 3):
            mesh = building(rng, 17.0, rng.uniform(9, 22), 10.0)
            t = (k * 17 + (8.5 if yaw < 0 else -8.5)) * 1.0
            yield mesh.placed(road.upright(s, t, 0.0, yaw))
    for side in (1, -1):
        s = start
        while s < end:
            width, height = rng.uniform(14, 30), rng.uniform(14, 38)
            t = road.section.front(side) + side * rng.uniform(24, 45)
            block = masonry(
                (0, 0, -3),
                (width, 12, height),
                Material.PANEL,
                rng.uniform(0.35, 0.7, 3),
                (0, 0, rng.uniform(0, 50), 0),
            )
            yield block.placed(road.upright(s if side > 0 else s + width, t, 0, 0 if side > 0 else np.pi))
            s += width + rng.uniform(4, 30)


def _pavements(seed: int, road: Road, start: float, end: float) -> Iterator[Mesh]:
    """Trees, lamps and small things along both kerbs."""
    # A long street (a log of over 60 frames or so) has thinner trees, which keeps it under 300 000 triangles.
    sparse = min(1.0, 260.0 / (end - start))
    for side in (1, -1):
        rng = generator(seed, f"pavement {side}")
        kerb = road.section.kerb(side)
        turn = 0.0 if side < 0 else np.pi
        pitch, leafy = rng.uniform(8, 20), rng.random() < 0.8
        size = rng.uniform(5.5, 9.0)
        s = start
        while s < end:
            s += pitch * rng.uniform(0.7, 1.3)
            if leafy and rng.random() < 0.85:
                mesh = furniture.tree(rng, size * rng.uniform(0.8, 1.2), int(rng.integers(900, 1500) * sparse))
                yield mesh.placed(road.upright(s, kerb + side * 0.95, KERB_HEIGHT_M, rng.uniform(0, 6.28)))
        for s in np.arange(start + rng.uniform(0, 20), end, rng.uniform(22, 34)):
            yield furniture.lamp(rng, rng.uniform(5.5, 7)).placed(
                road.upright(s, kerb + side * 0.55, KERB_HEIGHT_M, turn)
            )
        s = start
        while s < end:
            s += rng.uniform(3, 13)
            kind = rng.integers(5)
            if kind == 4:
                for k in range(4):
                    yield furniture.bollard(rng).placed(road.upright(s + 1.4 * k, kerb + side * 0.5, KERB_HEIGHT_M, 0))
                s += 5
                continue
            make = (furniture.sign, furniture.bin_, furniture.bench, furniture.sign)[kind]
            offset = (0.5, 0.6, 1.2, 0.5)[kind]
            yaw = turn if kind == 2 else (0.0 if side < 0 else np.pi)
            yield make(rng).placed(road.upright(s, kerb + side * offset, KERB_HEIGHT_M, yaw + rng.uniform(-0.1, 0.1)))


def _parked_cars(seed: int, road: Road, start: float, end: float) -> tuple[list[Parked], list[Mesh]]:
    parked: list[Parked] = []
    meshes: list[Mesh] = []
    for side in (1, -1):
        rng = generator(seed, f"parked {side}")
        density = rng.uniform(0.35, 0.9)
        s = start + rng.uniform(0, 5)
        while s < end:
            shape = draw_shape(rng)
            mesh = car(rng, shape)
            keep = rng.random() < density and bool(np.abs(road.crossings - s).min() > 5.5)
            wobble, turn = rng.uniform(-0.08, 0.08), rng.normal(0, 0.015) + (np.pi if rng.random() < 0.12 else 0.0)
            if keep:
                t = road.section.kerb(side) - side * (0.25 + shape.width / 2 + wobble)
                pose = road.pose(s, t, 0.0, turn + (np.pi if side > 0 else 0.0))
                name = f"parked-{'left' if side > 0 else 'right'}-{len(parked)}"
                parked.append(Parked(name, pose, (shape.length, shape.width + 0.1, shape.height)))
                meshes.append(mesh.placed(pose))
            s += shape.length + rng.uniform(0.7, 2.2)
    return parked, meshes


def _moving_cars(parameters: StreetParameters, road: Road, ego: Ego) -> Iterator[Actor]:
    """Cars in the lanes beside, before and behind the ego vehicle, never within reach of a camera shifted by ±5 m."""
    rng = generator(parameters.seed, "moving cars")
    inner, outer = road.section.oncoming[0], road.section.oncoming[-1]
    right = -3.5
    times = np.arange(parameters.frames) * FRAME_S
    path = ego.travel(times)
    slots = [(0.0, 1, 1), (inner, -1, 1), (right, 1, 1), (outer, -1, 1), (0.0, 1, -1), (inner, -1, -1), (right, 1, -1)]
    used: dict[tuple[float, int], float] = {}
    for k in range(parameters.moving):
        lane, way, place = slots[k % len(slots)]
        shape, speed = draw_shape(rng), max(ego.speed, 4.0) * rng.uniform(0.85, 1.25)
        gap = used.get((lane, place), _GAP_M) + rng.uniform(1.0, 12.0)
        used[(lane, place)] = gap + 6.0
        drift = way * speed * times - path
        # The nearest approach over the whole drive is the gap, whatever the speeds are.
        first = gap - drift.min() if place > 0 else -gap - drift.max()
        mesh = car(rng, shape)
        motion = _drive(road, float(first), way * speed, lane + rng.uniform(-0.15, 0.15))
        yield Actor(f"car-{k}", "Car", (Part(mesh),), (shape.length, shape.width + 0.1, shape.height), motion)


def _drive(road: Road, first: float, speed: float, lane: float) -> PoseAt:
    yaw = 0.0 if speed > 0 else np.pi

    def pose(times: ArrayLike) -> Float64:
        return road.pose(first + speed * np.asarray(times), lane, 0.0, yaw)

    return pose


def _pedestrians(parameters: StreetParameters, road: Road, ego: Ego) -> Iterator[Actor]:
    """People on the pavements near the drive, or as far from its lane as asked for; every fourth one stands."""
    rng = generator(parameters.seed, "pedestrians")
    reach = float(ego.travel(np.array([parameters.frames * FRAME_S]))[0])
    for k in range(parameters.pedestrians):
        side = 1 if rng.random() < 0.5 else -1
        kerb, front = road.section.kerb(side), road.section.front(side)
        t = kerb + (front - kerb) * rng.uniform(0.45, 0.8)
        t = side * parameters.pedestrians_aside_m or t
        pace = 0.0 if k % 4 == 3 else rng.uniform(0.9, 1.7)
        way = 1 if rng.random() < 0.5 else -1
        first = rng.uniform(4, 25 + reach)
        parts, size = pedestrian(rng, pace, parameters.stride)
        yield Actor(f"pedestrian-{k}", "Pedestrian", parts, size, _walk(road, first, way, pace, t))


def _walk(road: Road, first: float, way: int, pace: float, t: float) -> PoseAt:
    yaw = 0.0 if way > 0 else np.pi

    def pose(times: ArrayLike) -> Float64:
        return road.upright(first + way * pace * np.asarray(times), t, KERB_HEIGHT_M, yaw)

    return pose
