"""What a scene from a file looks like in numbers, and what about it a user should look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from genre_tasks.exchange.clouds import merge_clouds
from genre_tasks.exchange.conversion import DISTANT_NAME
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, SplatCloud
from genre_tasks.logs.types import Float64

_FLAT = 0.3
"""A Gaussian has a normal where its least scale is below this fraction of the next one."""

_FEWEST_NORMALS = 200
_GROUND_SHARE = 0.45
"""In a street's scene the ground's normals agree; those of facades point to two or more sides."""

_DISC = 1e-3
"""Discs of 2D Gaussian splatting are flatter than this fraction of their width."""

_MOST_DISCS = 0.9
_LARGE_M = 50.0
_FAR_M = 20_000.0
"""Beyond this, float32 positions are steps of millimetres."""


@dataclass(frozen=True)
class NodeSurvey:
    """A node in numbers.

    Attributes:
        name: of the node.
        gaussians: how many.
        extent_m: length of the box around the middle 98 % of its means, along x, y and z.
        sh_degree: of its spherical harmonics.
        opacity: those of the fifth and of the ninety-fifth Gaussian of a hundred.
        scale_m: the same of the largest standard deviation of each.
        moves: whether it has a motion.
    """

    name: str
    gaussians: int
    extent_m: tuple[float, float, float]
    sh_degree: int
    opacity: tuple[float, float]
    scale_m: tuple[float, float]
    moves: bool


def survey_node(node: ExchangeNode) -> NodeSurvey:
    """Measures a node.

    Args:
        node: any; one without Gaussians has zeros.

    >>> survey_node(ExchangeNode("background", SplatCloud.empty(sh_degree=3))).sh_degree
    3
    """
    cloud = node.cloud
    x, y, z = _measure_extent(cloud).tolist()
    return NodeSurvey(
        name=node.name,
        gaussians=len(cloud),
        extent_m=(x, y, z),
        sh_degree=cloud.sh_degree,
        opacity=_find_range(1.0 / (1.0 + np.exp(-cloud.logit_opacities.astype(np.float64)))),
        scale_m=_find_range(np.exp(cloud.log_scales.astype(np.float64)).max(1, initial=0.0)),
        moves=node.motion is not None,
    )


def find_scene_warnings(scene: ExchangeScene) -> tuple[str, ...]:
    """Looks for signs that a file means something else than its numbers say.

    Args:
        scene: as it was read.

    Returns:
        Sentences; empty where nothing stands out.
    """
    cloud = merge_clouds([node.cloud for node in scene.nodes if node.name != DISTANT_NAME])
    if not len(cloud):
        return ("The scene has no Gaussians.",)
    resting = merge_clouds([n.cloud for n in scene.nodes if n.motion is None and n.name != DISTANT_NAME])
    warnings = [*_check_up_axis(resting), *_check_discs(cloud), *_check_sizes(cloud)]
    if any(len(node.cloud) and node.cloud.antialiased is None for node in scene.nodes):
        warnings.append("The file does not say whether its Gaussians are anti-aliased: they are taken not to be.")
    return tuple(warnings)


def _check_up_axis(cloud: SplatCloud) -> list[str]:
    axis = _find_up_axis(cloud)
    if axis != 1:
        return []
    # The ground has most Gaussians, and what stands on it reaches away from it.
    low, middle, high = np.percentile(cloud.means[:, 1], [2, 50, 98])
    direction = "down" if high - middle < middle - low else "up"
    return [f"The scene looks as if y pointed {direction}, and GenRe takes z to point up: turn it before you render."]


def _find_up_axis(cloud: SplatCloud) -> int | None:
    """The axis that most surfaces face and that the scene is short along; ``None`` where they do not agree."""
    scales = np.sort(cloud.log_scales, axis=1)
    is_flat = scales[:, 0] - scales[:, 1] < np.log(_FLAT)
    # A quaternion of zeros turns nowhere, and formats may hold one.
    rows = np.flatnonzero(is_flat & (cloud.logit_opacities > 0) & cloud.quats.any(1))
    if len(rows) < _FEWEST_NORMALS:
        return None
    normals = _find_normals(cloud.select(rows))
    shares = np.square(normals).mean(0)
    axis = int(shares.argmax())
    extent = _measure_extent(cloud)
    return axis if shares[axis] > _GROUND_SHARE and int(extent.argmin()) == axis else None


def _find_normals(cloud: SplatCloud) -> Float64:
    """The axis of each Gaussian along which it is thinnest [N, 3]."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(np.roll(cloud.quats.astype(np.float64), -1, axis=1)).as_matrix()
    thinnest = cloud.log_scales.argmin(1)
    normals: Float64 = rotations[np.arange(len(cloud)), :, thinnest]
    return normals


def _check_discs(cloud: SplatCloud) -> list[str]:
    scales = np.sort(cloud.log_scales, axis=1)
    if (scales[:, 0] - scales[:, 1] < np.log(_DISC)).mean() < _MOST_DISCS:
        return []
    return ["The Gaussians are flat discs, as of 2D Gaussian splatting: they are rendered as ellipsoids."]


def _check_sizes(cloud: SplatCloud) -> list[str]:
    warnings = []
    large = int((cloud.log_scales.max(1) > np.log(_LARGE_M)).sum())
    if large:
        warnings.append(f"{large} Gaussians are larger than {_LARGE_M:g} m: a sky, or scales in another unit.")
    far = int((np.abs(cloud.means).max(1) > _FAR_M).sum())
    if far:
        warnings.append(f"{far} Gaussians are more than {_FAR_M / 1000:g} km away: their positions are rounded.")
    return warnings


def _measure_extent(cloud: SplatCloud) -> Float64:
    if not len(cloud):
        return np.zeros(3)
    low, high = np.percentile(cloud.means.astype(np.float64), [1, 99], axis=0)
    return np.asarray(high - low)


def _find_range(values: Float64 | Sequence[float]) -> tuple[float, float]:
    if not len(values):
        return 0.0, 0.0
    low, high = np.percentile(values, [5, 95])
    return float(low), float(high)
