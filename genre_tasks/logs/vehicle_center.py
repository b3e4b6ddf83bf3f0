"""Where the middle of the recording car is: at the origin of some logs' vehicles, and ahead of that of others."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from genre_tasks.logs.types import DrivingLog

REAR_AXLE_TO_CENTER_M = 1.4
"""From the rear axle of a passenger car ahead to its middle: half of 4.8 m, less a rear overhang of one metre.
It serves datasets whose vehicles have the origin there, and which do not document how long the car is."""


@runtime_checkable
class StatesVehicleCenter(Protocol):
    """A log that says where the middle of the recording car is.

    Attributes:
        center_ahead_m: how far it is ahead of the origin of ``DrivingLog.world_SE3_lidar``.
    """

    center_ahead_m: float


def find_center_ahead(log: DrivingLog) -> float:
    """Finds how far ahead of the ego vehicle's origin the middle of the car is.

    Args:
        log: any log.

    Returns:
        Metres; 0 where the log does not say it.
    """
    # A property beyond the protocol: logs of other packages need not have it.
    return float(log.center_ahead_m) if isinstance(log, StatesVehicleCenter) else 0.0
