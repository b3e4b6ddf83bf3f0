"""The axes of SPZ, and clouds turned into them and back.

A scene has x forward, y left and z up; SPZ has x right, y up and z back. Its x is so our −y, its y our z, its z our −x.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.exchange.sh_rotation import rotate_sh
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.types import Float64

SPZ_R_SCENE: Float64 = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""[3, 3] takes scene coordinates (x forward, y left, z up) to those of SPZ (x right, y up, z back)."""


def turn_to_spz(cloud: SplatCloud) -> SplatCloud:
    """Turns a cloud from the axes of a scene into those of SPZ.

    Args:
        cloud: N Gaussians, x forward, y left, z up.

    Returns:
        The same Gaussians, x right, y up, z back. Means, scales and quaternions change places and signs only, so that
        :func:`turn_from_spz` gives back their bits; harmonics are exact to float32.

    >>> ahead = replace(SplatCloud.empty(), means=np.array([[10.0, 0.0, 0.0]], np.float32))
    >>> turn_to_spz(ahead).means.tolist()
    [[0.0, 0.0, -10.0]]
    """
    return _swap_axes(cloud, SPZ_R_SCENE)


def turn_from_spz(cloud: SplatCloud) -> SplatCloud:
    """Turns a cloud from the axes of SPZ into those of a scene: the inverse of :func:`turn_to_spz`.

    Args:
        cloud: N Gaussians, x right, y up, z back.

    Returns:
        The same Gaussians, x forward, y left, z up.
    """
    return _swap_axes(cloud, SPZ_R_SCENE.T)


def _swap_axes(cloud: SplatCloud, rotation: Float64) -> SplatCloud:
    """Turns by a rotation that takes axes to axes.

    With A for the rotation, R for a Gaussian's and S for its scales, the covariance A R S² Rᵀ Aᵀ is that of the
    rotation A R Aᵀ with the scales of A S² Aᵀ. Both are places and signs changed, without a rounding.
    """
    source = np.abs(rotation).argmax(1)
    sign = rotation[np.arange(3), source].astype(np.float32)
    # A quaternion's last three are along its axis, and turn as a vector does. Adding 0 removes negative zeros.
    return replace(
        cloud,
        means=cloud.means[:, source] * sign + np.float32(0),
        log_scales=cloud.log_scales[:, source],
        quats=np.concatenate([cloud.quats[:, :1], cloud.quats[:, 1:][:, source] * sign + np.float32(0)], 1),
        sh_rest=rotate_sh(cloud.sh_rest, rotation),
    )
