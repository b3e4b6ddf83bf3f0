"""The true image of the synthetic street at any viewpoint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.synthetic.recent_values import RecentValues
from genre_tasks.logs.types import Float64, Lens

_CACHE_BYTES = 128 << 20

# (frame, street_SE3_camera, lens) → image; raises ``InputError`` for a frame that the log does not have.
RenderFrame = Callable[[int, Float64, Lens], NDArray[np.uint8]]


class StreetTruth:
    """``Truth`` of a street: the log's own ray-caster at any pose, remembered while it is likely to be asked again.

    Args:
        render: renders an image at a pose in the street's own coordinates.
        offset_m: [3] added to the street's coordinates to get the world's.
        log: name of the log, for errors.
    """

    def __init__(self, render: RenderFrame, offset_m: Float64, log: str) -> None:
        self._render = render
        self._offset_m = offset_m
        self._log = log
        self._images: RecentValues[NDArray[np.uint8]] = RecentValues(_CACHE_BYTES, lambda image: image.nbytes)

    def image(
        self,
        frame: int,
        world_SE3_camera: Float64,  # [4, 4]
        lens: Lens,
    ) -> NDArray[np.uint8]:  # [H, W, 3] sRGB, H × W of the lens
        """Renders what a camera at that pose would have seen at that frame's time.

        Args:
            frame: log frame.
            world_SE3_camera: [4, 4] pose of the camera.
            lens: lens of the camera; its size is the image's.

        Returns:
            [H, W, 3] sRGB, an array of the caller's own.

        Raises:
            InputError: no such frame, or a pose that is not finite.
        """
        street_SE3_camera = np.array(world_SE3_camera, np.float64)
        if street_SE3_camera.shape != (4, 4) or not np.isfinite(street_SE3_camera).all():
            problem = f"expected a finite pose of shape (4, 4), got shape {street_SE3_camera.shape}"
            remedy = "Check where the viewpoint comes from."
            raise InputError(problem, remedy=remedy, log=self._log, frame=frame)
        # In the array that was copied: the caller's pose stays.
        street_SE3_camera[:3, 3] -= self._offset_m
        key = (frame, street_SE3_camera.tobytes(), lens)
        # A copy, since what is remembered must not change when a caller draws into it.
        return self._images.get(key, lambda: self._render(frame, street_SE3_camera, lens)).copy()
