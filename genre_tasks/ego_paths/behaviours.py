"""Behaviours of the ego vehicle by name: other ways to drive that branch from the recorded path."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.behaviour_request import BehaviourRequest, Side
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import ConstantOffset, place_path
from genre_tasks.ego_paths.plausibility import check_recorded_driving
from genre_tasks.ego_paths.reference_path import fit_reference_path
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

PlanFunction = Callable[[BehaviourRequest], EgoPath]

REPLAY = "genre_tasks.ego_paths.recorded_driving:plan_recorded_driving"


@dataclass(frozen=True)
class Behaviour:
    """An entry of the registry.

    Attributes:
        target: ``"module:function"`` of a ``PlanFunction``, imported when it is first used.
        description: one line for a list.
        has_side: it goes to the left or to the right.
    """

    target: str
    description: str
    has_side: bool = False


BEHAVIOURS: dict[str, Behaviour] = {
    "brake": Behaviour("genre_tasks.ego_paths.brake:plan_brake", "slows down, to standstill at most"),
    "accelerate": Behaviour("genre_tasks.ego_paths.accelerate:plan_accelerate", "gains speed"),
    "lane-change": Behaviour("genre_tasks.ego_paths.lane_change:plan_lane_change", "moves a lane aside", True),
    "swerve": Behaviour("genre_tasks.ego_paths.swerve:plan_swerve", "moves aside and back again", True),
    "recorded": Behaviour(REPLAY, "drives as recorded, at the start offset"),
}


def plan_behaviour(
    name: str,
    recorded: EgoPath,
    config: SimulateConfig,
    *,
    start_offset_m: float,
    strength: float = 1.0,
    delay_s: float = 0.0,
    side: Side | None = None,
    allow_implausible: bool = False,
) -> EgoPath:
    """Plans a path that starts at a lateral offset from the recorded one, and then drives otherwise.

    Every path that it returns keeps within the bounds, as ``find_bound_violations`` measures them, unless others are
    allowed.

    Args:
        name: one of ``BEHAVIOURS``.
        recorded: one pose for each log frame.
        config: bounds, and what strength 1 stands for.
        start_offset_m: to the left of the recorded path; negative: to the right.
        strength: from 0, which drives as recorded at the offset.
        delay_s: seconds from the first pose to the begin of the manoeuvre.
        side: of a lane change or a swerve; by default the side of the recorded path, or the left where it starts on it.
        allow_implausible: whether the path may break the bounds.

    Returns:
        A path with the recorded times and frames.

    Raises:
        ConfigError: an unknown behaviour, a number out of range, or a manoeuvre that no vehicle can drive on this path.
        InputError: a recorded path without frames, or one of a vehicle that drives backwards.
    """
    if name not in BEHAVIOURS:
        remedy = f"{did_you_mean(name, BEHAVIOURS)}Behaviours: {', '.join(BEHAVIOURS)}."
        raise ConfigError(f"unknown behaviour {name!r}", remedy=remedy)
    reference = fit_reference_path(recorded)
    behaviour = BEHAVIOURS[name]
    _check_number(start_offset_m, "--start-offset", -100.0, 100.0)
    _check_number(strength, "--strength", 0.0, 100.0)
    _check_number(delay_s, "--delay", 0.0, reference.duration_s)
    if side is not None and not behaviour.has_side:
        sided = ", ".join(other for other, entry in BEHAVIOURS.items() if entry.has_side)
        raise ConfigError(f"{name} has no side", remedy=f"Leave `--side` out; it is for {sided}.")
    request = BehaviourRequest(
        name=name,
        recorded=recorded,
        reference=reference,
        config=config,
        start_offset_m=start_offset_m,
        strength=strength,
        delay_s=delay_s,
        side=side,
        allow_implausible=allow_implausible,
    )
    if strength == 0:
        return _load_function(REPLAY)(request)
    check_recorded_driving(request, place_path(reference, recorded, reference, ConstantOffset(start_offset_m)))
    return _load_function(behaviour.target)(request)


def _load_function(target: str) -> PlanFunction:
    module, _, function = target.partition(":")
    return cast(PlanFunction, getattr(importlib.import_module(module), function))


def _check_number(value: float, option: str, low: float, high: float) -> None:
    if not math.isfinite(value) or not low <= value <= high:
        raise ConfigError(f"{option} is {value:g}", remedy=f"Take a number from {low:g} to {high:.3g}.")
