"""Constants that the optimiser's torch code and its compiled kernel share, each once.

No imports: the kernel's build reads this file without torch.
"""

from __future__ import annotations

DEVIATION_FLOOR = 1e-20
"""Added to the root of the second moment, so that an attribute without gradient has none, instead of 0/0."""

VARYING = 62
"""Features that differ between Gaussians, the first ones; those behind them are the same for all."""

BLOCK = 48
"""Gaussians that the kernel takes at once: their features and hidden rows stay in the first-level cache."""
