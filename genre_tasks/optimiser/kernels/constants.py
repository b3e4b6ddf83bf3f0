"""Constants that the optimiser's torch code and its compiled kernel share, each once.

No imports: the kernel's build reads this file without torch.
"""

from __future__ import annotations

DEVIATION_FLOOR = 1e-20
"""Added to the root of the second moment, so that an attribute without gradient has none, instead of 0/0."""

SHARE_FLOOR_PX = 0.5
"""Added to the pixels that a Gaussian has shares of, where something is divided by them."""

VARYING, RESIDUALS = 62, 5
"""Features that differ between Gaussians, the first ones, and of residuals, where a network asks for them. Those behind
them are the same for all."""

BLOCK = 48
"""Gaussians that the kernel takes at once: their features and hidden rows stay in the first-level cache."""
