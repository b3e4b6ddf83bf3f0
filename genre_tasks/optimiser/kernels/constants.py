"""Constants that the optimiser's torch code and its compiled kernel share.

No imports: the kernel's build reads this file without torch.
"""

from __future__ import annotations

RMS_FLOOR = 1e-20
"""Added to the root of the second moment, so that an attribute without gradient gets a step of 0 instead of 0/0."""

WEIGHT_FLOOR_PX = 0.5
"""Added to a Gaussian's total blending weight, in pixels, where something is divided by it."""

VARYING_FEATURES = 62
"""The first features of the network, which differ between Gaussians. Those behind them are the same for all."""

IMAGE_RESIDUALS = 5
"""Columns of image residuals, and as many features where a network uses them, between the varying and the others."""

# Features and hidden rows of this many Gaussians stay in the first-level cache.
BLOCK_GAUSSIANS = 48
"""Gaussians that a thread of the kernel takes at a time."""
