"""Which camera of a rig looks straight ahead, and which to the left of that, whatever a dataset calls them."""

from __future__ import annotations

from collections.abc import Sequence

from genre_tasks.errors import ConfigError

_SIDES = ("left", "right", "side")


def select_front_camera(names: Sequence[str]) -> str:
    """Selects the camera that looks straight ahead.

    Args:
        names: of the rig, at least one.

    >>> select_front_camera(["left_camera", "front_left_camera", "front_camera"])
    'front_camera'
    >>> select_front_camera(["ring_front_left", "ring_front_center"])
    'ring_front_center'
    """

    def rank(name: str) -> tuple[bool, bool, int]:
        words = name.lower()
        # Of several front cameras the shortest name is the one that looks straight ahead.
        return "front" not in words, any(side in words for side in _SIDES), len(name)

    return min(names, key=rank)


def select_front_left_camera(names: Sequence[str]) -> str:
    """Selects the camera between the one that looks straight ahead and the one that looks to the left.

    Args:
        names: of the rig.

    Raises:
        ConfigError: no name has both "front" and "left".

    >>> select_front_left_camera(["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT"])
    'CAM_FRONT_LEFT'
    """
    # The word alone: datasets write it in upper and lower case.
    found = [name for name in names if "front" in name.lower() and "left" in name.lower()]
    if not found:
        raise ConfigError(
            "the rig has no front-left camera",
            remedy=f"Take a log with one; this one has {', '.join(names) or 'no camera'}.",
        )
    return min(found, key=len)
