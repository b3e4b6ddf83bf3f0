"""Transforms of a stage, of which Gaussians can follow a rotation, a translation and one scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.types import Float64

_TOLERANCE = 1e-4
"""How far a transform may be from a similarity: files of half precision round theirs."""

_EXACT = 1e-9
"""Rotations nearer to orthogonal than this stay as they are, so that files of ours come back unchanged."""


def split_similarity(matrix: Float64, prim: str, file: Path) -> tuple[float, Float64]:
    """Splits a transform into a scale and a rigid motion.

    Args:
        matrix: [4, 4] finite.
        prim: what it places, for errors.
        file: for errors.

    Returns:
        The scale, and the rigid motion [4, 4] that follows it.

    Raises:
        InputError: the transform shears, mirrors, flattens, or scales axes differently.

    >>> scale, pose = split_similarity(np.diag([2.0, 2.0, 2.0, 1.0]), "/Scene", Path("scene.usda"))
    >>> round(scale, 6), pose[0, 0].round(6).tolist()
    (2.0, 1.0)
    """
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    scale = np.cbrt(determinant)
    rotation = linear / scale if determinant > 0 else np.zeros((3, 3))
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if determinant <= 0 or not deviation <= _TOLERANCE or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(
            f"{prim} is sheared, mirrored or scaled unevenly",
            remedy="Apply its transform to the Gaussians in the program that wrote the file.",
            file=file,
        )
    if deviation > _EXACT:
        # The nearest rotation.
        left, _, right = np.linalg.svd(rotation)
        rotation = left @ right
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = matrix[:3, 3]
    return (1.0 if abs(scale - 1.0) < _EXACT else float(scale)), pose


def scale_cloud(cloud: SplatCloud, scale: float) -> SplatCloud:
    """Scales a cloud about the origin.

    Args:
        cloud: any.
        scale: above 0; at 1 the cloud comes back as it is.
    """
    if scale == 1.0:
        return cloud
    return replace(
        cloud,
        means=(cloud.means * np.float64(scale)).astype(np.float32),
        log_scales=(cloud.log_scales + np.log(scale)).astype(np.float32),
    )


def place_cloud(cloud: SplatCloud, matrix: Float64, prim: str, file: Path) -> SplatCloud:
    """Applies a transform to a cloud that rests.

    Args:
        cloud: any.
        matrix: [4, 4] finite.
        prim: what it places, for errors.
        file: for errors.

    Returns:
        The cloud in the scene's coordinates, the same one where it is there already.

    Raises:
        InputError: as :func:`split_similarity`.
    """
    scale, pose = split_similarity(matrix, prim, file)
    scaled = scale_cloud(cloud, scale)
    return scaled if np.array_equal(pose, np.eye(4)) else transform_cloud(scaled, pose)
