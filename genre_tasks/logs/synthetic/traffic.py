"""Who moves on the street, and how: cars in the lanes, people on the pavements."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from genre_tasks.logs.synthetic.cars import build_car, draw_car_shape
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, EgoDrive
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.pedestrians import build_pedestrian
from genre_tasks.logs.synthetic.road import KERB_HEIGHT_M, LANE_M, Road, make_generator
from genre_tasks.logs.synthetic.street_actors import Actor, Part, PoseAt
from genre_tasks.logs.types import Float64

_MIN_GAP_M = 9.0
_AHEAD = 1
_BEHIND = -1


def drive_cars(parameters: StreetParameters, road: Road, ego: EgoDrive) -> Iterator[Actor]:
    """Lets cars drive beside, before and behind the ego vehicle.

    None comes within reach of a camera that is shifted by ±5 m.

    Args:
        parameters: seed, and how many cars.
        road: the street.
        ego: how the ego vehicle drives.

    Yields:
        The cars.
    """
    rng = make_generator(parameters.seed, "moving cars")
    ego_lane = 0.0
    inner = road.section.oncoming[0]
    outer = road.section.oncoming[-1]
    right = -LANE_M
    times = np.arange(parameters.frames) * FRAME_S
    ego_distance = ego.distance(times)
    # Lane, direction (+1 with the ego vehicle, −1 oncoming), and whether the car is ahead of it or behind.
    slots = [
        (ego_lane, 1, _AHEAD),
        (inner, -1, _AHEAD),
        (right, 1, _AHEAD),
        (outer, -1, _AHEAD),
        (ego_lane, 1, _BEHIND),
        (inner, -1, _BEHIND),
        (right, 1, _BEHIND),
    ]
    # Two cars in one lane keep a gap to each other as well.
    next_gap: dict[tuple[float, int], float] = {}
    for k in range(parameters.moving):
        lane, direction, place = slots[k % len(slots)]
        shape = draw_car_shape(rng)
        # Traffic goes on when the ego vehicle stands.
        speed = max(ego.speed, 4.0) * rng.uniform(0.85, 1.25)
        gap = next_gap.get((lane, place), _MIN_GAP_M) + rng.uniform(1.0, 12.0)
        next_gap[(lane, place)] = gap + 6.0
        drift = direction * speed * times - ego_distance
        # The nearest approach over the whole drive is the gap, whatever the speeds are.
        start = gap - drift.min() if place == _AHEAD else -gap - drift.max()
        mesh = build_car(rng, shape)
        motion = _drive_along(road, float(start), direction * speed, lane + rng.uniform(-0.15, 0.15))
        yield Actor(f"car-{k}", "Car", (Part(mesh),), shape.size_m, motion)


def _drive_along(road: Road, start: float, speed: float, t: float) -> PoseAt:
    """Poses of a car that is at s = ``start`` at time 0; a negative speed is oncoming."""
    yaw = 0.0 if speed > 0 else np.pi

    def pose(times: ArrayLike) -> Float64:
        return road.pose(start + speed * np.asarray(times), t, 0.0, yaw)

    return pose


def walk_pedestrians(parameters: StreetParameters, road: Road, ego: EgoDrive) -> Iterator[Actor]:
    """Lets people walk near the drive; every fourth one stands.

    Args:
        parameters: seed, how many people, how their limbs swing, and how far from the ego lane they are.
        road: the street.
        ego: how the ego vehicle drives.

    Yields:
        The people.
    """
    rng = make_generator(parameters.seed, "pedestrians")
    distance = float(ego.distance(np.array([parameters.frames * FRAME_S]))[0])
    for k in range(parameters.pedestrians):
        side = 1 if rng.random() < 0.5 else -1
        kerb = road.section.kerb(side)
        on_pavement = kerb + (road.section.front(side) - kerb) * rng.uniform(0.45, 0.8)
        # Drawn in either case, so that the parameter moves people without changing them.
        t = side * parameters.pedestrians_aside_m or on_pavement
        pace = 0.0 if k % 4 == 3 else rng.uniform(0.9, 1.7)
        direction = 1 if rng.random() < 0.5 else -1
        start = rng.uniform(4, 25 + distance)
        parts, size_m = build_pedestrian(rng, pace, parameters.stride)
        yield Actor(f"pedestrian-{k}", "Pedestrian", parts, size_m, _walk_along(road, start, direction, pace, t))


def _walk_along(road: Road, start: float, direction: int, pace: float, t: float) -> PoseAt:
    """Poses of a person who is at s = ``start`` at time 0."""
    yaw = 0.0 if direction > 0 else np.pi

    def pose(times: ArrayLike) -> Float64:
        return road.upright_pose(start + direction * pace * np.asarray(times), t, KERB_HEIGHT_M, yaw)

    return pose
