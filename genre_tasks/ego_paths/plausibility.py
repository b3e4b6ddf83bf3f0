"""The guarantee of every planned path: within the bounds, or an error that says what breaks them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import BoundViolation, find_bound_violations
from genre_tasks.errors import ConfigError

_NAMED_VIOLATIONS = 2


def describe_violations(violations: Sequence[BoundViolation]) -> str:
    """Writes violations for an error, the worst ones first.

    Args:
        violations: at least one.

    Returns:
        One clause; of many violations it names two.
    """
    worst = sorted(violations, key=lambda violation: violation.value / violation.bound, reverse=True)
    named = ", ".join(str(violation) for violation in worst[:_NAMED_VIOLATIONS])
    more = len(worst) - _NAMED_VIOLATIONS
    return f"{named}, and {more} more" if more > 0 else named


def check_recorded_driving(request: BehaviourRequest, path: EgoPath) -> EgoPath:
    """Refuses a behaviour where the recorded driving alone, at the start offset, breaks the bounds.

    Args:
        request: of any behaviour.
        path: the recorded one, moved by the offset.

    Returns:
        The path.

    Raises:
        ConfigError: it does.
    """
    violations = find_bound_violations(path, request.config.bounds)
    if violations and not request.allow_implausible:
        offset = request.start_offset_m
        moved = f", moved by {offset:.3g} m," if offset else ""
        remedy = "Widen simulate.bounds in the configuration, or take other chunks."
        if offset:
            remedy = f"Start nearer to the recorded path: `--start-offset {0.5 * offset:.3g}`. Or: {remedy}"
        raise ConfigError(
            f"the recorded path itself{moved} breaks the bounds: {describe_violations(violations)}", remedy=remedy
        )
    return path


def check_planned_path(request: BehaviourRequest, path: EgoPath) -> EgoPath:
    """Refuses a planned path that breaks the bounds.

    Args:
        request: what it was planned for.
        path: the planned path.

    Returns:
        The path.

    Raises:
        ConfigError: it does.
    """
    violations = find_bound_violations(path, request.config.bounds)
    if violations and not request.allow_implausible:
        raise ConfigError(
            f"{request.name} at strength {request.strength:.3g} breaks the bounds: {describe_violations(violations)}",
            remedy=f"Ask for less: `--strength {0.5 * request.strength:.2g}`. Or widen simulate.bounds.",
        )
    return path


def check_rate(request: BehaviourRequest, rate_m_s2: float, bound_m_s2: float, quantity: str) -> float:
    """Scales an acceleration by the strength.

    Args:
        request: has the strength.
        rate_m_s2: at strength 1.
        bound_m_s2: the largest one.
        quantity: its name for the error.

    Returns:
        The acceleration, m/s².

    Raises:
        ConfigError: it is more than the bound.
    """
    rate = request.strength * rate_m_s2
    if rate > bound_m_s2 and not request.allow_implausible:
        problem = f"{request.name} at strength {request.strength:.3g} has the {quantity} {rate:.3g} m/s²"
        # Rounded down, so that the strength in the remedy is one that works.
        largest = math.floor(100 * bound_m_s2 / rate_m_s2) / 100
        raise ConfigError(
            f"{problem}, the bound is {bound_m_s2:g}",
            remedy=f"Ask for less: `--strength {largest:g}`, or widen simulate.bounds.",
        )
    return rate
