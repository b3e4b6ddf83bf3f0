"""Poses from progress along the reference and distance to its left: Frenet coordinates.

With arc length s, offset d to the left, its slope d' = dd/ds and the reference's curvature κ, the vehicle at speed ṡ
along the reference drives at ``ṡ · √((1 − κ d)² + d'²)``, turned by ``atan2(d', 1 − κ d)`` against the reference
(Werling et al., "Optimal trajectory generation for dynamic street scenarios in a Frenet frame", ICRA 2010).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.reference_path import ReferencePath
from genre_tasks.logs.types import Float64

_MIN_STRETCH = 0.1
"""Least 1 − κ d: at 0 the offset is the centre of the curve, where a path has no direction."""


class Progress(Protocol):
    """How far a vehicle has come along the reference."""

    def locate(self, times_s: Float64) -> Float64:
        """Finds the arc length.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] metres.
        """
        ...

    def measure_speed(self, times_s: Float64) -> Float64:
        """Finds the speed along the reference.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] m/s.
        """
        ...


class LateralOffset(Protocol):
    """How far to the left of the reference a vehicle drives."""

    def evaluate(self, arc_m: Float64, derivative: int = 0) -> Float64:
        """Evaluates the offset.

        Args:
            arc_m: [N] arc length of the reference.
            derivative: by arc length: 0, 1 or 2.

        Returns:
            [N] metres, 1 or 1/m.
        """
        ...


@dataclass(frozen=True)
class ConstantOffset:
    """An offset that stays.

    Attributes:
        offset_m: to the left.
    """

    offset_m: float

    def evaluate(self, arc_m: Float64, derivative: int = 0) -> Float64:
        """Evaluates the offset.

        Args:
            arc_m: [N] arc length of the reference.
            derivative: by arc length.

        Returns:
            [N].
        """
        return np.full(len(arc_m), self.offset_m if derivative == 0 else 0.0)


@dataclass(frozen=True)
class LateralMotion:
    """The exact lateral motion at dense moments, without what sampling at the log's rate smooths away.

    Attributes:
        times_s: [T].
        lateral_acceleration_m_s2: [T].
        lateral_jerk_m_s3: [T].
        curvature_1_m: [T].
    """

    times_s: Float64
    lateral_acceleration_m_s2: Float64
    lateral_jerk_m_s3: Float64
    curvature_1_m: Float64


def place_path(reference: ReferencePath, recorded: EgoPath, progress: Progress, offset: LateralOffset) -> EgoPath:
    """Places the poses of a motion along the reference.

    Height, roll and pitch are those of the recorded vehicle at that place; the yaw follows the motion.

    Args:
        reference: of the recorded path.
        recorded: whose times and frames the path takes over.
        progress: along the reference.
        offset: to its left.

    Returns:
        One pose for each recorded one.
    """
    arc = progress.locate(recorded.times_s - recorded.times_s[0])
    poses = place_poses(reference, arc, offset.evaluate(arc), offset.evaluate(arc, 1))
    return EgoPath(recorded.times_s, recorded.frames, poses)


def place_poses(reference: ReferencePath, arc_m: Float64, offset_m: Float64, slope: Float64) -> Float64:
    """Places poses next to the reference.

    Args:
        reference: of the recorded path.
        arc_m: [P] along it.
        offset_m: [P] to its left.
        slope: [P] change of the offset over arc length.

    Returns:
        world_SE3_ego [P, 4, 4].
    """
    points = reference.sample(arc_m)
    about_z = np.zeros((len(arc_m), 3))
    about_z[:, 2] = points.heading_rad + np.arctan2(slope, 1 - points.curvature_1_m * offset_m)
    poses = np.tile(np.eye(4), (len(arc_m), 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(about_z) * Rotation.from_rotvec(points.attitude_rad)).as_matrix()
    poses[:, :3, 3] = points.position_m
    poses[:, 0, 3] -= offset_m * np.sin(points.heading_rad)
    poses[:, 1, 3] += offset_m * np.cos(points.heading_rad)
    return poses


def measure_lateral_motion(
    reference: ReferencePath, times_s: Float64, progress: Progress, offset: LateralOffset
) -> LateralMotion | None:
    """Measures the lateral motion without smoothing.

    Args:
        reference: of the recorded path.
        times_s: [T] seconds, dense.
        progress: along the reference.
        offset: to its left.

    Returns:
        The motion, or ``None`` where the offset reaches the centre of a curve.
    """
    arc = progress.locate(times_s)
    points = reference.sample(arc)
    slope = offset.evaluate(arc, 1)
    stretch = 1 - points.curvature_1_m * offset.evaluate(arc)
    if stretch.min() < _MIN_STRETCH:
        return None
    length = np.hypot(stretch, slope)
    stretch_change = -points.curvature_change_1_m2 * offset.evaluate(arc) - points.curvature_1_m * slope
    turn_change = (offset.evaluate(arc, 2) * stretch - slope * stretch_change) / length**2
    curvature = (points.curvature_1_m + turn_change) / length
    speed = progress.measure_speed(times_s) * length
    lateral = curvature * speed**2
    return LateralMotion(times_s, lateral, np.gradient(lateral, times_s), curvature)
