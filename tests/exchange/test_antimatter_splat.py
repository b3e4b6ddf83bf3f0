"""Files of 32 bytes a Gaussian."""

from __future__ import annotations

from genre_tasks.exchange.cloud_errors import CloudErrors
from tests.exchange.format_suite import FormatSuite


class TestAntimatterSplat(FormatSuite):
    name = "splat"
    sh_degrees = (0,)
    keeps_antialiasing = False
    cut_attributes = frozenset({"sh_dc"})
    tolerances = CloudErrors(
        means_m=0, log_scales=1e-6, angles_rad=0.02, opacities=0.5 / 255 + 1e-6, colors=0.5 / 255 + 1e-6, sh_rest=0
    )
