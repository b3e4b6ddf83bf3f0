"""Whether the ego vehicle moves as vehicles do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding

# 250 km/h: no recording vehicle is faster on a public road.
_MAX_SPEED_M_S = 70.0


def find_implausible_motion(sample: LogSample) -> Iterator[Finding]:
    """Finds steps between frames that no vehicle drives.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``implausible_speed`` with the speed of the fastest step.
    """
    positions = sample.world_SE3_lidar[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    periods_s = np.diff(sample.times_s)
    with np.errstate(invalid="ignore", divide="ignore"):
        speeds = np.where(periods_s > 0, steps_m / periods_s, np.nan)
    fast = np.flatnonzero(speeds > _MAX_SPEED_M_S)
    if fast.size:
        fastest = float(np.nanmax(speeds))
        yield Finding(
            "implausible_speed",
            "warning",
            f"the ego vehicle moves at {fastest:.0f} m/s in {fast.size} of {speeds.size} steps",
            "Check the unit of poses and times: metres, and seconds, milliseconds or microseconds.",
            numbers={"speed_m_s": fastest, "limit_m_s": _MAX_SPEED_M_S},
            frames=tuple(sample.frames[int(step) + 1] for step in fast),
        )
