"""Which image of a camera belongs to which frame, where cameras are not in step with the LiDAR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def find_nearest_images(
    frame_times: Sequence[int], image_times: Sequence[int], assumed_period: int
) -> list[int | None]:
    """Gives each frame its nearest image; an image belongs to one frame at most.

    Args:
        frame_times: [F] increasing times, in any whole unit.
        image_times: [N] times in the same unit, in any order.
        assumed_period: what a frame lasts where there is only one.

    Returns:
        [F] indices of images; ``None`` where the nearest image is farther than half a frame, or nearer to another one.

    >>> find_nearest_images([0, 100, 200], [260, 12, 60, 104], 100)
    [1, 3, None]
    """
    frames = np.asarray(frame_times, dtype=np.int64)
    images = np.asarray(image_times, dtype=np.int64)
    if not len(frames) or not len(images):
        return [None] * len(frames)
    order = np.argsort(images, kind="stable")
    owners = frames[_find_nearest(frames, images)]
    nearest = order[_find_nearest(images[order], frames)]
    period = float(np.median(np.diff(frames))) if len(frames) > 1 else float(assumed_period)
    # Farther away, it is the image of a frame that the log lacks.
    is_near = np.abs(images[nearest] - frames) <= period / 2
    # Where frames lie close together, two of them may have the same nearest image.
    is_owner = owners[nearest] == frames
    return [int(index) if use else None for index, use in zip(nearest, is_near & is_owner, strict=True)]


def _find_nearest(times: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """[N] for each wanted time the index of the nearest of the increasing times; of two, the earlier one."""
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(wanted - times[before]) <= np.abs(times[after] - wanted), before, after)
