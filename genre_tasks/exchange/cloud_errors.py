"""How far two clouds of the same Gaussians are apart, in units that mean something."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from genre_tasks.exchange.activations import logits_to_opacities, sh_dc_to_colors
from genre_tasks.exchange.clouds import with_sh_degree
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.types import Float32, Float64


@dataclass(frozen=True)
class CloudErrors:
    """The largest difference of each attribute over all Gaussians; 0 where there are none.

    Attributes:
        means_m: metres, along an axis.
        log_scales: of natural logarithms, so that 0.01 is one per cent.
        angles_rad: of rotations, whatever the sign and length of quaternions.
        opacities: in [0, 1].
        colors: of constant terms; 1 is from black to white.
        sh_rest: of coefficients; those that a cloud lacks are 0.
    """

    means_m: float
    log_scales: float
    angles_rad: float
    opacities: float
    colors: float
    sh_rest: float

    def exceed(self, tolerances: CloudErrors) -> tuple[str, ...]:
        """Names the attributes whose difference is above a tolerance, or is not a number.

        Args:
            tolerances: the most for each attribute.

        >>> CloudErrors(0, 0, 0, 0, 0.1, 0).exceed(CloudErrors(0, 0, 0, 0, 0, 0))
        ('colors',)
        """
        most = asdict(tolerances)
        # Written so that NaN exceeds everything.
        return tuple(name for name, value in asdict(self).items() if not value <= most[name])


def compare_clouds(before: SplatCloud, after: SplatCloud) -> CloudErrors:
    """Compares clouds of the same Gaussians in the same order.

    Args:
        before: N Gaussians.
        after: N Gaussians.

    Returns:
        The largest differences.

    Raises:
        ValueError: they differ in number.

    >>> compare_clouds(SplatCloud.empty(), SplatCloud.empty()).means_m
    0.0
    """
    if len(before) != len(after):
        raise ValueError(f"expected {len(before)} Gaussians, got {len(after)}")
    degree = max(before.sh_degree, after.sh_degree)
    return CloudErrors(
        means_m=_largest(before.means.astype(np.float64) - after.means),
        log_scales=_largest(before.log_scales.astype(np.float64) - after.log_scales),
        angles_rad=_largest(_measure_angles(before.quats, after.quats)),
        opacities=_largest(logits_to_opacities(before.logit_opacities) - logits_to_opacities(after.logit_opacities)),
        colors=_largest(sh_dc_to_colors(before.sh_dc) - sh_dc_to_colors(after.sh_dc)),
        sh_rest=_largest(with_sh_degree(before, degree).sh_rest - with_sh_degree(after, degree).sh_rest),
    )


def _measure_angles(before: Float32, after: Float32) -> Float64:
    a = before.astype(np.float64)
    b = after.astype(np.float64)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    # From the chord and not the cosine, which knows no angle below 1e-8.
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.asarray(4 * np.arcsin(np.minimum(chord / 2, 1)))


def _largest(differences: Float32 | Float64) -> float:
    return float(np.abs(differences).max(initial=0.0))
