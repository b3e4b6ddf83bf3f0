"""GLB files with KHR_gaussian_splatting."""

from __future__ import annotations

from genre_tasks.exchange.cloud_errors import CloudErrors
from tests.exchange.format_suite import FormatSuite


class TestGlb(FormatSuite):
    name = "glb"
    sh_degrees = (0, 1, 2, 3)
    tolerances = CloudErrors(means_m=0, log_scales=1e-6, angles_rad=1e-6, opacities=1e-6, colors=0, sh_rest=0)
