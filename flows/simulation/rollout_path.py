"""The path of a rollout: planned or read, checked against what vehicles can do and against the traffic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flows.simulation.path_file import read_path_file
from flows.simulation.request import SimulationRequest
from genre_tasks.config import SimulateConfig
from genre_tasks.ego_paths.behaviours import plan_behaviour
from genre_tasks.ego_paths.collisions import Collision, find_collisions
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import BoundViolation, Kinematics, compare_with_bounds, measure_kinematics
from genre_tasks.ego_paths.world_actors import WorldActor
from genre_tasks.errors import ConfigError

RECORDED = "recorded"
"""The behaviour that drives as recorded."""
_SHOWN_COLLISIONS = 3


@dataclass(frozen=True)
class CheckedPath:
    """A path that is going to be rendered, and what was found about it.

    Attributes:
        path: P poses.
        recorded: the recorded path.
        violations: of kinematic bounds; empty unless they are allowed.
        collisions: with actors; empty unless they are allowed.
        colliding: by the index of a pose, the actors that it meets.
        maxima: largest amounts of the path's motion, by quantity and unit.
    """

    path: EgoPath
    recorded: EgoPath
    violations: tuple[BoundViolation, ...]
    collisions: tuple[Collision, ...]
    colliding: dict[int, tuple[str, ...]]
    maxima: dict[str, float]


def make_path(request: SimulationRequest, config: SimulateConfig, recorded: EgoPath) -> EgoPath:
    """Plans or reads the path that a request asks for.

    Args:
        request: with a behaviour, a file with poses, or neither: the recorded path, moved to the side.
        config: of the simulation.
        recorded: the recorded path of the run.

    Returns:
        P poses.

    Raises:
        ConfigError: there is no such behaviour, or it does not go with the recorded path.
        InputError: the file holds no path.
    """
    if request.path_file is not None:
        return read_path_file(request.path_file, recorded)
    if request.behaviour is None and not request.start_offset_m:
        return recorded
    offset_m = config.start_offset_m if request.start_offset_m is None else request.start_offset_m
    return plan_behaviour(
        request.behaviour or RECORDED,
        recorded,
        config,
        start_offset_m=offset_m,
        strength=request.strength,
        delay_s=request.delay_s,
        side=request.side,
        allow_implausible=request.allow_implausible,
    )


def check_path(
    request: SimulationRequest,
    config: SimulateConfig,
    path: EgoPath,
    recorded: EgoPath,
    actors: Sequence[WorldActor],
    center_ahead_m: float = 0.0,
) -> CheckedPath:
    """Checks a path against the kinematic bounds and the boxes of actors.

    Args:
        request: says what is allowed all the same.
        config: bounds and margin.
        path: to check.
        recorded: the recorded path.
        actors: as they are simulated, and parked ones.
        center_ahead_m: how far ahead of the path's poses the middle of the vehicle is.

    Returns:
        The path with what was found.

    Raises:
        ConfigError: the path breaks a bound or meets an actor, and that is not allowed.
    """
    motion = measure_kinematics(path)
    violations = compare_with_bounds(motion, config.bounds)
    if violations and not request.allow_implausible:
        found = "; ".join(str(violation) for violation in violations)
        raise ConfigError(
            f"no vehicle drives like this: {found}",
            remedy="Choose a smaller --strength or --start-offset, or render it all the same by --allow-implausible.",
        )
    margin_m = config.collision_margin_m
    collisions = find_collisions(path, actors, margin_m, center_ahead_m=center_ahead_m)
    if collisions and not request.allow_collision:
        found = "; ".join(str(collision) for collision in collisions[:_SHOWN_COLLISIONS])
        more = len(collisions) - _SHOWN_COLLISIONS
        raise ConfigError(
            f"the path meets other road users: {found}{f'; and {more} more' if more > 0 else ''}",
            remedy="Choose another --start-offset, --side or --delay, or render it all the same by --allow-collision.",
        )
    met = {collision.actor_id for collision in collisions}
    colliding = _find_colliding_poses(path, [a for a in actors if a.actor_id in met], margin_m, center_ahead_m)
    return CheckedPath(path, recorded, violations, collisions, colliding, _list_maxima(motion))


def _find_colliding_poses(
    path: EgoPath, actors: Sequence[WorldActor], margin_m: float, center_ahead_m: float
) -> dict[int, tuple[str, ...]]:
    """The actors that each pose meets, by its index; poses that meet none are left out."""
    if not actors:
        return {}
    colliding = {}
    for index in range(len(path)):
        here = slice(index, index + 1)
        pose = EgoPath(path.times_s[here], path.frames[here], path.world_SE3_ego[here])
        found = find_collisions(pose, actors, margin_m, center_ahead_m=center_ahead_m)
        names = tuple(collision.actor_id for collision in found)
        if names:
            colliding[index] = names
    return colliding


def _list_maxima(motion: Kinematics) -> dict[str, float]:
    """Largest amounts of a motion, by quantity and unit."""
    maxima = {
        "speed_m_s": motion.speed_m_s.max(),
        "acceleration_m_s2": motion.acceleration_m_s2.max(),
        "deceleration_m_s2": (-motion.acceleration_m_s2).max(),
        "lateral_acceleration_m_s2": np.abs(motion.lateral_acceleration_m_s2).max(),
        "jerk_m_s3": np.abs(motion.jerk_m_s3).max(),
        "lateral_jerk_m_s3": np.abs(motion.lateral_jerk_m_s3).max(),
        "curvature_1_m": np.abs(motion.curvature_1_m).max(),
    }
    return {name: float(value) for name, value in maxima.items()}
