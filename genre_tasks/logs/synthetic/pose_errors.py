"""Errors of the recorded camera poses: mounts that are not quite known, a rig that drifts, images that come late."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.road import make_generator
from genre_tasks.logs.types import Float64

# Share of the variance that is a camera's mount and stays. The rest is of the whole rig and drifts as the log goes on.
_CONSTANT_SHARE = 0.6

# One swing in four to eight seconds: inertial sensors are smooth from frame to frame, satellites pull slowly.
_DRIFT_HZ = (0.12, 0.25)


@dataclass(frozen=True)
class PoseErrors:
    """What a log says of its cameras, against where they are.

    Attributes:
        parameters: of the street.
    """

    parameters: StreetParameters

    @property
    def is_exact(self) -> bool:
        """Whether recorded poses are those of the images, to the bit."""
        p = self.parameters
        return not (p.pose_noise_deg or p.pose_noise_m or p.camera_delay_s)

    def ego_SE3_recorded_ego(self, time_s: float) -> Float64:
        """Draws the drift of the rig.

        Args:
            time_s: seconds since the first frame.

        Returns:
            [4, 4] the recorded pose of the rig in its true axes.
        """
        rng = make_generator(self.parameters.seed, "drift of the rig")
        phase = rng.uniform(0, 2 * np.pi, 6)
        hertz = rng.uniform(*_DRIFT_HZ, 6)
        # The root of two gives the sine a standard deviation of 1.
        return self._compose(np.sqrt(2 * (1 - _CONSTANT_SHARE)) * np.sin(2 * np.pi * hertz * time_s + phase))

    def camera_SE3_recorded_camera(self, camera: str) -> Float64:
        """Draws the error of a camera's mount.

        Args:
            camera: name of the camera.

        Returns:
            [4, 4] the recorded pose of the camera in its true axes.
        """
        rng = make_generator(self.parameters.seed, f"mount of {camera}")
        return self._compose(np.sqrt(_CONSTANT_SHARE) * rng.normal(size=6))

    def _compose(self, unit: Float64) -> Float64:
        """The rigid motion of six numbers of variance 1: a turn and a shift of the sizes that were asked for."""
        p = self.parameters
        out = np.eye(4)
        # A third of the variance for each axis, so that the size is that of the whole turn or shift.
        out[:3, :3] = Rotation.from_rotvec(np.radians(p.pose_noise_deg) * unit[:3] / np.sqrt(3)).as_matrix()
        out[:3, 3] = p.pose_noise_m * unit[3:] / np.sqrt(3)
        return out
