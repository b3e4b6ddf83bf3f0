"""Paths that are stated relative to the recorded one: metres to the left of it, and ahead."""

from __future__ import annotations

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import place_poses
from genre_tasks.ego_paths.reference_path import fit_reference_path
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

_STANDING_M_S = 0.1
"""Who drives slower does not turn for going sideways. As a speed, it holds however dense the poses of a path are."""

# So far before the first recorded pose is rounding.
_BEFORE_START_M = 0.01


def place_relative_path(
    recorded: EgoPath, times_s: Float64, frames: Float64, lateral_m: Float64, ahead_m: Float64
) -> EgoPath:
    """Places a path relative to the recorded one.

    Args:
        recorded: one pose for each log frame.
        times_s: [P] seconds, rising.
        frames: [P] log frames, or moments between them.
        lateral_m: [P] to the left of the recorded path.
        ahead_m: [P] along the recorded path, ahead of the recorded vehicle at that moment; negative: behind.

    Returns:
        The path; the vehicle points where it drives.

    Raises:
        InputError: a pose lies before the first recorded one, or in the centre of a curve.
    """
    reference = fit_reference_path(recorded)
    recorded_s = np.interp(frames, recorded.frames, recorded.times_s - recorded.times_s[0])
    arc = reference.locate(recorded_s) + ahead_m
    before = np.flatnonzero(arc < -_BEFORE_START_M)
    if len(before):
        row = int(before[0])
        raise InputError(
            f"pose {row} of the path is {-arc[row]:.1f} m before the first recorded one",
            remedy="Take a larger ahead_m, or poses in the world's coordinates.",
        )
    arc = np.maximum(arc, 0.0)
    if len(arc) > 1:
        driven = np.gradient(arc)
        drives = np.abs(driven) > _STANDING_M_S * np.gradient(times_s)
        slope = np.where(drives, np.gradient(lateral_m) / np.where(driven == 0, 1, driven), 0.0)
    else:
        slope = np.zeros(1)
    stretch = 1 - reference.sample(arc).curvature_1_m * lateral_m
    if stretch.min() <= 0:
        row = int(np.argmin(stretch))
        raise InputError(
            f"pose {row} of the path, {lateral_m[row]:.1f} m to the left, is past the centre of the curve",
            remedy="Stay nearer to the recorded path there, or state poses in the world's coordinates.",
        )
    return EgoPath(times_s - times_s[0], frames, place_poses(reference, arc, lateral_m, slope))
