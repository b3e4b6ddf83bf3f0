"""The image loss's numeric constants, each once; the kernel is compiled with these very values.

No imports: the kernel's build reads this file where torch may be absent.
"""

from __future__ import annotations

RADIUS = 5
"""Half the width of SSIM's window, pixels: 11 taps along each axis (Wang et al. 2004)."""

SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels (Wang et al. 2004)."""

# (K₁ L)² and (K₂ L)² with Wang's K₁ = 0.01 and K₂ = 0.03, for images of range L = 1.
C1 = 0.01**2
"""Keeps SSIM's luminance finite for black images in [0, 1] (Wang et al. 2004)."""

C2 = 0.03**2
"""Keeps SSIM's structure finite for constant images in [0, 1] (Wang et al. 2004)."""

DEPTH_MIN_M = 1e-3
"""Smaller rendered depths count as this one in the relative depth loss, and have no gradient there."""

DEPTH_LOSS_MAX = 1.0
"""A pixel's relative depth error is clamped to this, so that a missing surface cannot outweigh the rest."""
