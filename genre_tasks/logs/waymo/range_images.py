"""Points of range images, as Waymo's own code computes them.

A row is a beam, whose inclination the calibration states; a column is an azimuth, from +π at the left to −π at the
right, less the yaw of the LiDAR on the vehicle. Each pixel of the upper LiDAR has its own pose of the vehicle, since
the vehicle moves within a turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float32, Float64


@dataclass(frozen=True)
class LidarCalibration:
    """Where a LiDAR is, and where its beams go.

    Attributes:
        vehicle_SE3_lidar: [4, 4].
        inclinations_rad: [H] of the beams, from the lowest to the highest; empty where they are spread evenly.
        lowest_rad: where the lowest beam's row ends.
        highest_rad: where the highest beam's row ends.
    """

    vehicle_SE3_lidar: Float64
    inclinations_rad: Float64
    lowest_rad: float
    highest_rad: float

    def row_inclinations(self, height: int) -> Float64:
        """Computes inclinations of the rows of a range image.

        Args:
            height: rows.

        Returns:
            [H] radians, from the upper row to the lower one.

        Raises:
            ValueError: the calibration is for another number of rows.

        >>> LidarCalibration(np.eye(4), np.zeros(0), -0.2, 0.2).row_inclinations(2)
        array([ 0.1, -0.1])
        """
        if not len(self.inclinations_rad):
            parts = (np.arange(height) + 0.5) / height
            return (self.lowest_rad + parts * (self.highest_rad - self.lowest_rad))[::-1]
        if len(self.inclinations_rad) != height:
            raise ValueError(f"a range image has {height} rows, and the calibration {len(self.inclinations_rad)}")
        return self.inclinations_rad[::-1]


def compute_points(
    range_image: Float32, calibration: LidarCalibration, world_SE3_vehicle: Float64, pixel_poses: Float32 | None
) -> tuple[Float64, Float32]:
    """Computes the points of a range image.

    Args:
        range_image: [H, W, 4] range in metres, intensity, elongation and a flag; no range above 0: no return.
        calibration: of the LiDAR.
        world_SE3_vehicle: [4, 4] of the frame.
        pixel_poses: [H, W, 6] roll, pitch, yaw and x, y, z of the vehicle in the world; ``None``: those of the frame.

    Returns:
        [N, 3] points in the world and [N] intensities as the file has them; values that are not finite stay.

    Raises:
        ValueError: the calibration or the poses are for another size.
    """
    height, width = range_image.shape[:2]
    if pixel_poses is not None and pixel_poses.shape[:2] != (height, width):
        raise ValueError(f"poses of pixels are {pixel_poses.shape[:2]}, and the range image is {(height, width)}")
    # Most of a range image may be sky; only pixels with a return are computed.
    rows, columns = np.nonzero(range_image[..., 0] > 0)
    distances = range_image[rows, columns, 0].astype(np.float64)
    mount = calibration.vehicle_SE3_lidar
    # Columns are even in the axes of the vehicle, whichever way the LiDAR is mounted.
    yaw = np.arctan2(mount[1, 0], mount[0, 0])
    azimuths = (2.0 * (width - columns - 0.5) / width - 1.0) * np.pi - yaw
    inclinations = calibration.row_inclinations(height)[rows]
    level = np.cos(inclinations) * distances
    local = np.stack([np.cos(azimuths) * level, np.sin(azimuths) * level, np.sin(inclinations) * distances], axis=1)
    in_vehicle = local @ mount[:3, :3].T + mount[:3, 3]
    intensity: NDArray[np.float32] = range_image[rows, columns, 1]
    if pixel_poses is None:
        return in_vehicle @ world_SE3_vehicle[:3, :3].T + world_SE3_vehicle[:3, 3], intensity
    poses = pixel_poses[rows, columns].astype(np.float64)
    # First roll about x, then pitch about y, then yaw about z.
    turned: Float64 = Rotation.from_euler("xyz", poses[:, :3]).apply(in_vehicle) if len(poses) else in_vehicle
    return turned + poses[:, 3:], intensity
