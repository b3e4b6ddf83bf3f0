"""Where the middle of the recording car is: at the origin of some datasets' vehicles, and ahead of that of others."""

from __future__ import annotations

REAR_AXLE_TO_CENTER_M = 1.4
"""From the rear axle of a passenger car ahead to its middle: half of 4.8 m, less a rear overhang of one metre.
It serves datasets whose vehicles have the origin there without saying how long the car is, and simulators whose rig is
there."""

_CENTER_AHEAD_M = {
    "argoverse2": REAR_AXLE_TO_CENTER_M,
    # Its car is known: see CAR_LOW_M and CAR_HIGH_M of the reader.
    "nuscenes": 1.3,
    "waymo": REAR_AXLE_TO_CENTER_M,
}


def find_center_ahead(uri: str, stated_m: float | None = None) -> float:
    """Finds how far ahead of the ego vehicle's origin the middle of the car is.

    By the reader's name and not by the log: a scene is simulated where its log is not, and stays where it is.

    Args:
        uri: of a log.
        stated_m: what the setting ``simulate.center_ahead_m`` says; ``None``: nothing.

    Returns:
        Metres, as stated. Otherwise 0 for readers whose origin is the middle, and for those that do not say it.

    >>> find_center_ahead("nuscenes:data/scene-0103"), find_center_ahead("pandaset:data/002")
    (1.3, 0.0)
    """
    return _CENTER_AHEAD_M.get(uri.partition(":")[0], 0.0) if stated_m is None else stated_m
