"""The rollouts of the paper's table 6: which behaviours, from where they start, and as strong as the log allows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from genre_tasks.config import SimulateConfig
from genre_tasks.errors import ConfigError

if TYPE_CHECKING:
    from genre_tasks.ego_paths.ego_path import EgoPath
    from genre_tasks.ego_paths.world_actors import WorldActor

BEHAVIOUR_LABELS = {"brake": "brake", "accelerate": "accelerate", "lane-change": "change lane", "swerve": "swerve"}
"""The behaviours in the paper's order, with the words of its table's heading."""
STRENGTHS = (1.0, 0.75, 0.5, 0.25)
"""Strengths in the order in which they are tried: a short log or other traffic may leave no room for a strong one."""
START_OFFSET_M = 3.0
"""Paper Sec. IV-C: each rollout starts 3 m to the side of the recorded path."""
_START_STEP_M = 0.5
"""By how much nearer to the recorded path a start is tried where a road user is in the way of every strength."""


@dataclass(frozen=True)
class TableRollout:
    """A rollout that a table measures.

    Attributes:
        behaviour: a name in ``BEHAVIOUR_LABELS``.
        start_offset_m: metres to the left of the recorded path at its start; below 0 to the right. Where road users
            are, :func:`plan_rollout` starts nearer to the path.
    """

    behaviour: str
    start_offset_m: float

    @property
    def name(self) -> str:
        """The first part of its metrics' names.

        >>> TableRollout("swerve", -3.0).name
        'swerve_right'
        """
        return f"{self.behaviour}_{'left' if self.start_offset_m >= 0 else 'right'}"

    def __str__(self) -> str:
        return f"{self.behaviour} from {self.start_offset_m:+g} m"


TABLE_ROLLOUTS = tuple(
    TableRollout(name, offset) for name in BEHAVIOUR_LABELS for offset in (START_OFFSET_M, -START_OFFSET_M)
)
"""The rollouts of table 6: both sides of the recorded path, as in the evaluation of lateral shifts."""


@dataclass(frozen=True)
class PlannedRollout:
    """A rollout on one log.

    Attributes:
        rollout: what was asked for.
        path: where the vehicle drives.
        start_offset_m: where it starts, metres to the left of the recorded path; below 0 to the right.
        strength: of the behaviour, one of ``STRENGTHS``.
        collisions: overlaps with road users, a clause each; they are there only where no start and strength avoid them.
    """

    rollout: TableRollout
    path: EgoPath
    start_offset_m: float
    strength: float
    collisions: tuple[str, ...] = ()

    def __str__(self) -> str:
        return str(replace(self.rollout, start_offset_m=self.start_offset_m))


def plan_rollout(
    rollout: TableRollout,
    recorded: EgoPath,
    config: SimulateConfig,
    actors: Sequence[WorldActor] = (),
    center_ahead_m: float = 0.0,
) -> PlannedRollout:
    """Plans a behaviour as far beside the recorded path, and then as strong, as the log has room for.

    The paper's rollouts were vetted by hand for plausibility. Here a rule does it, which knows the path and the log
    alone, so that every method drives the same. An image from within another vehicle would compare with nothing.

    Args:
        rollout: what to drive.
        recorded: the recorded path.
        config: what a vehicle can do.
        actors: road users that it should not meet.
        center_ahead_m: how far ahead of the path's poses the middle of the vehicle is.

    Returns:
        The path of the largest of ``STRENGTHS`` that a vehicle can drive without meeting a road user, from the start
        that was asked for. Where there is none, the start is moved towards the recorded path by half a metre at a time.
        Where none of these starts is free either, the strongest from the start that was asked for.

    Raises:
        ConfigError: the log is too short for the least strength, or there is no behaviour of that name.
        InputError: the recorded path is none that a vehicle drives forwards.
    """
    # Imported here: a request is checked before anything numeric is loaded.
    from genre_tasks.ego_paths.behaviours import plan_behaviour
    from genre_tasks.ego_paths.collisions import find_collisions

    first: PlannedRollout | None = None
    refusal: ConfigError | None = None
    for start_offset_m in _list_starts(rollout.start_offset_m):
        for strength in STRENGTHS:
            try:
                path = plan_behaviour(
                    rollout.behaviour, recorded, config, start_offset_m=start_offset_m, strength=strength
                )
            except ConfigError as error:
                refusal = error
                continue
            found = find_collisions(path, actors, config.collision_margin_m, center_ahead_m=center_ahead_m)
            collisions = tuple(str(collision) for collision in found)
            planned = PlannedRollout(rollout, path, start_offset_m, strength, collisions)
            if not collisions:
                return planned
            first = first or planned
        # A start nearer to the path helps against road users, and not where the log itself is too short.
        if first is None:
            break
    if first is not None:
        return first
    # The last one's error says what is in the way, with its numbers.
    raise refusal or AssertionError("STRENGTHS is not empty")


def _list_starts(start_offset_m: float) -> list[float]:
    """Lists the start that was asked for, and those between it and the recorded path.

    >>> _list_starts(-1.5)
    [-1.5, -1.0, -0.5]
    """
    count = max(1, math.ceil(abs(start_offset_m) / _START_STEP_M))
    return [math.copysign(abs(start_offset_m) - k * _START_STEP_M, start_offset_m) for k in range(count)]


def take_every(path: EgoPath, every: int) -> EgoPath:
    """Takes every n-th pose of a path.

    Args:
        path: P poses.
        every: 1 for all of them.
    """
    return replace(
        path, times_s=path.times_s[::every], frames=path.frames[::every], world_SE3_ego=path.world_SE3_ego[::every]
    )
