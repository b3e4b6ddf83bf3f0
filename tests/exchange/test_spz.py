"""SPZ files."""

from __future__ import annotations

import numpy as np

from genre_tasks.exchange.cloud_errors import CloudErrors
from genre_tasks.exchange.sh_rotation import compute_sh_rotations
from genre_tasks.exchange.spz.axes import SPZ_R_SCENE
from tests.exchange.format_suite import FormatSuite

# A harmonic is rounded in the axes of SPZ, and turning it back adds up the errors of those that it is mixed from.
SH_STEP = 1 / 128
SH_MIXING = max(float(np.abs(matrix).sum(1).max()) for matrix in compute_sh_rotations(SPZ_R_SCENE, 4))


class TestSpz(FormatSuite):
    name = "spz"
    cut_attributes = frozenset({"sh_dc", "sh_rest", "log_scales"})
    tolerances = CloudErrors(
        means_m=0.5 / 4096 + 1e-6,
        log_scales=0.5 / 16 + 1e-6,
        angles_rad=0.005,
        opacities=0.5 / 255 + 1e-6,
        colors=0.5 / 255 / 0.15 * 0.2820948 + 1e-6,
        sh_rest=0.5 * SH_STEP * SH_MIXING + 1e-6,
    )
