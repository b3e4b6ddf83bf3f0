"""Constants of the scene's Gaussians that a kernel is compiled with. No imports: its build reads this without torch."""

from __future__ import annotations

ABSENT_LOGIT = -30.0
"""Logit opacity of the Gaussians of an actor that does not exist at a frame: no renderer draws them."""

LARGEST_LOG_SCALE = 88.0
"""Above it the scale, over 1e38 m, is constant, so that neither value nor gradient overflows."""

LOWEST_LOGIT = -80.0
"""Below it the opacity, under 1e-34, is constant, so that neither value nor gradient overflows."""
