"""The renderer's numeric constants, each once, with its reason; the kernel is compiled with these very values.

They are the values the field agrees on (3DGS, gsplat) unless the comment says otherwise. No imports: the kernel's build
reads this file without torch.
"""

from __future__ import annotations

NEAR_M = 0.01
"""Gaussians nearer than this (camera z, metres) are culled; 0.2, as in the first 3DGS code, hides close geometry."""

BLUR_PX2 = 0.3
"""Added to both diagonal entries of the projected covariance: a Gaussian covers at least about one pixel."""

COMPENSATION_MIN = 0.005
"""Least factor by which anti-aliasing lowers an opacity for what ``BLUR_PX2`` adds to its footprint: where a footprint
has next to no area its determinant is all rounding, and its gradient ends here (3DGS clamps the square at 0.005²)."""

ALPHA_MIN = 1.0 / 255.0
"""Contributions below one 8-bit level are skipped; a Gaussian whose opacity is below is culled."""

ALPHA_MAX = 0.99
"""Keeps 1 − α invertible in the backward pass; the gradient in opacity and footprint is zero where it clamps."""

TRANSMITTANCE_STOP = 9.99e-5
"""A ray ends before a layer that would leave less: two opaque splats, (1 − ALPHA_MAX)² = 1e-4, end a ray.

A thousandth below 1e-4, so that rounding does not decide (in float32 the square is just below 1e-4, in float64 above).
"""

JACOBIAN_MARGIN = 0.3
"""The linearisation point is limited to the image edge plus this × tan(fov / 2), per side: EWA explodes off-axis."""

QUAT_MIN_NORM2 = 1e-6
"""Quaternions with a smaller squared norm are culled: they do not say a rotation, and their gradient explodes."""

MAX_VARIANCE_PX2 = 1e18
"""Projected variances above are culled (footprints of 1e9 px): their determinant leaves the range of float32."""

MAX_CENTER_PX = 1e7
"""Projected centres farther off are culled: from 2^24 ≈ 1.7e7 on a float32 pixel coordinate misses whole pixels."""

SHUTTER_MIN_RATE = 0.1
"""Least rate, against a resting point's, at which a rolling shutter's rows pass a point: see ``Shutter``.

A point whose row moves down as fast as the rows are read is exposed for ever, and one that moves faster is passed
backwards; only a point that crosses the whole image within the readout comes near to either. Its time is limited to the
readout in any case; this keeps the quotient and its gradient finite.
"""

CULL_REASONS = ("non_finite", "quaternion", "behind", "degenerate", "folded")
"""Reasons counted in ``Render.culled``. Being outside of the image or below ``ALPHA_MIN`` is ordinary, not counted."""
