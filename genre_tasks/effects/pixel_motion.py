"""Motion of cameras over the scene, in pixels: rolling shutter and motion blur are the same property over two times."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import ImageKey, Measurement
from genre_tasks.logs.types import Camera, Float64
from genre_tasks.scene.chunk import View

# The near part moves fastest over the image, but the fastest return of all would be a stray one.
FLOW_QUANTILE = 0.95
"""Of the flow of a view's LiDAR returns."""

Vector = tuple[float, float, float]
Motion = TypeVar("Motion")


@dataclass(frozen=True)
class MotionDuringImage:
    """What rolling shutter and motion blur have in common: a camera moves while a stated time passes.

    Attributes:
        duration_s: the time that a camera states, in seconds; 0 where it states none.
        activity: what happens to the camera meanwhile, for the plan's reason.
        quantity: name of the time, for the reason that it is missing.
    """

    duration_s: Callable[[Camera], float]
    activity: str
    quantity: str

    def find_missing(self, measurements: ChunkMeasurements) -> str | None:
        """Tells whether the log lacks the time.

        Args:
            measurements: the chunk's cameras.

        Returns:
            A sentence for the plan's reason; ``None`` where at least one camera states the time.
        """
        if any(self.duration_s(camera) > 0 for camera in measurements.cameras.values()):
            return None
        return f"the log states no {self.quantity}"

    def measure(self, measurements: ChunkMeasurements) -> Measurement:
        """Measures how far the image moves during the time.

        Args:
            measurements: the chunk's poses and LiDAR returns.

        Returns:
            Pixels, of the camera whose image moves farthest.
        """
        durations = {name: self.duration_s(camera) for name, camera in measurements.cameras.items()}
        displacements = {
            name: speed * durations[name]
            for name, speed in measure_pixel_speeds(measurements).items()
            if durations.get(name, 0.0) > 0
        }
        if not displacements:
            problem = f"no camera that is {self.activity} for a stated time has two images and LiDAR returns"
            return Measurement(None, problem)
        fastest = max(displacements, key=lambda name: displacements[name])
        explanation = f"{fastest} is {self.activity} for {1e3 * durations[fastest]:g} ms"
        return Measurement(displacements[fastest], explanation)

    def fit(self, measurements: ChunkMeasurements, make: Callable[..., Motion]) -> dict[ImageKey, Motion]:
        """Estimates how the cameras that state the time move at each of their images.

        Args:
            measurements: the chunk's poses.
            make: ``RollingShutter`` or ``MotionBlur``.

        Returns:
            What ``make`` made of each image.
        """
        durations = {name: self.duration_s(camera) for name, camera in measurements.cameras.items()}
        stated = [name for name, duration_s in durations.items() if duration_s > 0]
        motions = estimate_camera_motions(measurements, stated)
        frame_s = _frame_interval_s(measurements)
        return {
            key: make(durations[key[0]], velocity_m_s=velocity, turn_rad_s=turn, frame_s=frame_s)
            for key, (velocity, turn) in motions.items()
        }


def measure_pixel_speeds(measurements: ChunkMeasurements) -> dict[str, float]:
    """Measures how fast the images of each camera move.

    The speed of a view is the flow of its LiDAR returns under the camera's velocity, at the 95th percentile, plus
    f · |ω|. Driving ahead moves what is off the axis too: the flow is (x · v_z − v_x) · f / Z.

    Args:
        measurements: the chunk's poses and LiDAR returns.

    Returns:
        Pixels per second at the working resolution, of each camera's fastest source view. A camera without LiDAR
        returns or without a second image is left out.
    """
    speeds: dict[str, float] = {}
    for view, returns in zip(measurements.source_views, measurements.lidar_returns, strict=True):
        neighbour = _find_neighbour_in_time(measurements, view)
        # Without returns the depth is unknown, and with it how far the scene moves in the image.
        if neighbour is None or not len(returns.depth):
            continue
        (vx, vy, vz), turn = _relative_motion(view, neighbour)
        lens = view.lens
        x = (returns.uv[:, 0] - lens.cx_px) / lens.fx_px
        y = (returns.uv[:, 1] - lens.cy_px) / lens.fy_px
        flow = np.hypot(lens.fx_px * (x * vz - vx), lens.fy_px * (y * vz - vy)) / returns.depth
        # A turn moves all pixels about alike. The sum is an upper bound, because turn and translation may cancel.
        speed = float(np.quantile(flow, FLOW_QUANTILE)) + max(lens.fx_px, lens.fy_px) * turn
        # The fastest view counts: one strongly sheared image is enough to spoil a scene.
        speeds[view.camera] = max(speeds.get(view.camera, 0.0), speed)
    return speeds


def estimate_camera_motions(
    measurements: ChunkMeasurements, cameras: Collection[str]
) -> dict[ImageKey, tuple[Vector, Vector]]:
    """Estimates how cameras move at their images, from the poses before and after each.

    Args:
        measurements: the chunk's poses.
        cameras: names of the cameras that count.

    Returns:
        Velocity in m/s and turn in rad/s, both in camera axes. A camera with one image, or whose images are of one
        time, is left out.
    """
    motions: dict[ImageKey, tuple[Vector, Vector]] = {}
    for name in (n for n in measurements.cameras if n in cameras):
        views = sorted((v for v in measurements.chunk.views if v.camera == name), key=lambda v: v.frame)
        for k, view in enumerate(views):
            # Central differences: one-sided ones are late or early by half a frame.
            before = views[max(k - 1, 0)]
            after = views[min(k + 1, len(views) - 1)]
            if after.timestamp_s > before.timestamp_s:
                motions[name, view.frame] = _motion_between(view, before, after)
    return motions


def _frame_interval_s(measurements: ChunkMeasurements) -> float:
    """Seconds from a frame to the next: one number for all cameras, whose clocks differ by microseconds."""
    times_by_camera: dict[str, list[tuple[int, float]]] = {}
    for view in measurements.chunk.views:
        times_by_camera.setdefault(view.camera, []).append((view.frame, view.timestamp_s))
    intervals = [
        (later_s - earlier_s) / (later_frame - earlier_frame)
        for times in times_by_camera.values()
        for (earlier_frame, earlier_s), (later_frame, later_s) in itertools.pairwise(sorted(times))
    ]
    # The median, because a dropped image or a late clock would shift a mean.
    return float(np.median(intervals)) if intervals else 0.0


def _motion_between(view: View, before: View, after: View) -> tuple[Vector, Vector]:
    """Velocity and turn from the pose ``before`` to that ``after``, in the axes of ``view``."""
    seconds = after.timestamp_s - before.timestamp_s
    camera_R_chunk = view.chunk_SE3_camera[:3, :3].T
    translation = after.chunk_SE3_camera[:3, 3] - before.chunk_SE3_camera[:3, 3]
    rotation = after.chunk_SE3_camera[:3, :3] @ before.chunk_SE3_camera[:3, :3].T
    vx, vy, vz = camera_R_chunk @ translation / seconds
    wx, wy, wz = camera_R_chunk @ Rotation.from_matrix(rotation).as_rotvec() / seconds
    return (float(vx), float(vy), float(vz)), (float(wx), float(wy), float(wz))


def _find_neighbour_in_time(measurements: ChunkMeasurements, view: View) -> View | None:
    """The same camera's next image; the previous one at the chunk's end."""
    others = [v for v in measurements.chunk.views if v.camera == view.camera and v.timestamp_s != view.timestamp_s]
    # The frame's number counts and not its time, which may be out of order in a log.
    later = [v for v in others if v.frame > view.frame]
    return min(later or others, key=lambda v: abs(v.frame - view.frame), default=None)


def _relative_motion(view: View, other: View) -> tuple[Float64, float]:
    """Velocity [3] in the camera's axes, m/s, and the rate of turn, rad/s."""
    seconds = other.timestamp_s - view.timestamp_s
    relative = np.linalg.inv(view.chunk_SE3_camera) @ other.chunk_SE3_camera
    # A magnitude has no sign, so only the time's sign has to be removed.
    turn = float(Rotation.from_matrix(relative[:3, :3]).magnitude())
    return relative[:3, 3] / seconds, turn / abs(seconds)
