"""The image loss's numeric constants, each once; the kernel is compiled with these very values.

No imports: the kernel's build reads this file without torch.
"""

from __future__ import annotations

RADIUS = 5
SIGMA = 1.5
"""SSIM's window: 11 taps of a Gaussian along each axis (Wang et al. 2004)."""

C1 = 0.01**2
C2 = 0.03**2
"""Wang's constants for images in [0, 1]: they keep constant and black images finite."""

DEPTH_MIN_M = 1e-3
"""Rendered depths below count as this in the relative depth loss, without a gradient."""

DEPTH_LOSS_MAX = 1.0
"""A pixel's relative depth error is clamped here: a missing surface cannot outweigh the rest."""
