"""One Gauss–Newton step of pose alignment: from brightness of points in images to motions of mounts and of the rig."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from genre_tasks.logs.brown_conrady import distort, distortion_jacobian
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.chunk import View
from genre_tasks.scene.lens_distortion import fold_radius
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.threads import map_single_threaded, multiply_transposed, torch_threads

TURN_PRIOR_DEG = 0.2
"""Standard deviation that is expected of a mount's and of the rig's turn."""

SHIFT_PRIOR_M = 0.05
"""The same of a mount's shift."""

RIG_SHIFT_PRIOR_M = 0.2
"""The same of the rig's shift, which is larger: a clock that is 10 ms late moves it by 30 cm on a motorway."""

TURN_STEP_PRIOR_DEG = 0.1
"""Standard deviation that is expected of the change of the rig's turn from one source frame to the next."""

SHIFT_STEP_PRIOR_M = 0.03
"""The same of its shift."""

# Differences of normalised brightness from here on count less and less: occlusions, reflections, moving shadows.
_OUTLIER = 0.5
_REWEIGHTINGS = 2
# Points side by side err alike, so that each counts for less than one observation.
_INDEPENDENT_SHARE = 0.1
# Of a normal distribution: its variance over the square of its median absolute deviation, 1.4826².
_VARIANCE_OF_MEDIAN = 2.2
_BORDER_PX = 3
_NEAR_M = 1.0
_TINY = 1e-9


class AlignedImage(NamedTuple):
    """A view with its image at the width of the comparison, and where its motions are among the unknowns.

    Attributes:
        view: as the chunk has it.
        lens: at the size of ``luma``.
        luma: [H, W] brightness in [0, 1].
        chunk_SE3_ego: [4, 4] LiDAR pose at the view's frame.
        mount: number of the camera.
        rig: number of the source frame.
    """

    view: View
    lens: Lens
    luma: Float32
    chunk_SE3_ego: Float64
    mount: int
    rig: int


class ImageSlopes(NamedTuple):
    """An image at one blur, without the brightness and contrast of its surroundings.

    Attributes:
        brightness: [H, W].
        by_u: [H, W] slope along columns, per pixel.
        by_v: [H, W] slope along rows, per pixel.
    """

    brightness: Float32
    by_u: Float32
    by_v: Float32


def compose_motion(six: Float64) -> Float64:
    """Composes a rigid motion.

    Args:
        six: [6] turn as a rotation vector in radians, and shift in metres.

    Returns:
        [4, 4].

    >>> compose_motion(np.array([0.0, 0, 0, 1, 2, 3]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(six[:3]).as_matrix()
    out[:3, 3] = six[3:]
    return out


def move_pose(pose: Float64, chunk_SE3_ego: Float64, mount: Float64, rig: Float64) -> Float64:
    """Moves a camera by the motions of its mount and of the rig.

    Args:
        pose: [4, 4] chunk_SE3_camera.
        chunk_SE3_ego: [4, 4] of the same frame.
        mount: [6] motion in the camera's axes.
        rig: [6] motion in the axes of the LiDAR pose.

    Returns:
        [4, 4] the moved pose.
    """
    ego_SE3_camera = invert_se3(chunk_SE3_ego) @ pose
    moved: Float64 = chunk_SE3_ego @ compose_motion(rig) @ ego_SE3_camera @ compose_motion(mount)
    return moved


def compute_pose(image: AlignedImage, mounts: Float64, rig: Float64) -> Float64:
    """Computes the pose of an image's camera after the motions.

    Args:
        image: one of the images.
        mounts: [C, 6] motions of the mounts.
        rig: [F, 6] motions of the rig.

    Returns:
        [4, 4] chunk_SE3_camera.
    """
    return move_pose(image.view.chunk_SE3_camera, image.chunk_SE3_ego, mounts[image.mount], rig[image.rig])


def project_points(points: Float64, pose: Float64, lens: Lens) -> tuple[Float64, Float64, Float64, NDArray[np.bool_]]:
    """Projects points into an image.

    Args:
        points: [P, 3] metres, chunk coordinates.
        pose: [4, 4] chunk_SE3_camera.
        lens: of the image.

    Returns:
        Points in camera axes [P, 3]; their columns and rows [P] as indices of pixels, 0 at the first one's centre; and
        which are well inside [P].
    """
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = np.where(local[:, 2] > _NEAR_M, local[:, 2], np.inf)
    x: Float64 = local[:, 0] / z
    y: Float64 = local[:, 1] / z
    inside = np.isfinite(z)
    if any(lens.distortion):
        # Rays beyond would be folded back into the image.
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
        bent = distort(x, y, lens.coefficients)
        x, y = bent[0].astype(np.float64), bent[1].astype(np.float64)
    # Half a pixel: an index is that of a pixel's centre.
    u = x * lens.fx_px + lens.cx_px - 0.5
    v = y * lens.fy_px + lens.cy_px - 0.5
    inside &= (u > _BORDER_PX) & (u < lens.width_px - _BORDER_PX - 1)
    inside &= (v > _BORDER_PX) & (v < lens.height_px - _BORDER_PX - 1)
    return local, u, v, inside


def take_step(
    points: Float64,
    observed: NDArray[np.bool_],
    images: Sequence[AlignedImage],
    levels: Sequence[ImageSlopes],
    mounts: Float64,
    rig: Float64,
) -> tuple[Float64, Float64] | None:
    """Takes one Gauss–Newton step of all motions; a point's own brightness is eliminated.

    Args:
        points: [P, 3] metres, chunk coordinates.
        observed: [V, P] which views see which points.
        images: V images.
        levels: their brightness at one blur.
        mounts: [C, 6] present motions of the mounts.
        rig: [F, 6] present motions of the rig.

    Returns:
        The motions after the step; ``None`` where no point is well inside an image.
    """
    brightness = np.zeros(observed.shape)
    seen = np.zeros(observed.shape, bool)

    def measure_image(k: int) -> Float64:
        image = images[k]
        level = levels[k]
        index = np.flatnonzero(observed[k])
        local, u, v, inside = project_points(points.take(index, axis=0), compute_pose(image, mounts, rig), image.lens)
        well_inside = np.flatnonzero(inside)
        index = index.take(well_inside)
        seen[k, index] = True
        where = np.stack([v.take(well_inside), u.take(well_inside)])
        brightness[k, index] = map_coordinates(level.brightness, where, order=1)
        slope_u = map_coordinates(level.by_u, where, order=1) * image.lens.fx_px
        slope_v = map_coordinates(level.by_v, where, order=1) * image.lens.fy_px
        return _slopes_by_motion(image, mounts[image.mount], local.take(well_inside, axis=0), slope_u, slope_v)

    slopes = map_single_threaded(measure_image, range(len(images)))
    if not seen.any():
        return None
    residual, weight = _robust_residual(brightness, seen)
    # One thread: sums do not depend on the number of cores.
    with torch_threads(1):
        return _solve(slopes, seen, residual, weight, images, mounts, rig)


def _slopes_by_motion(
    image: AlignedImage, mount: Float64, local: Float64, slope_u: Float64, slope_v: Float64
) -> Float64:
    """Slopes [P, 12] of brightness by the six numbers of the mount and of the rig."""
    x, y, z = local.T
    if any(image.lens.distortion):
        xx, xy, yy = distortion_jacobian(x / z, y / z, image.lens.coefficients)
        slope_u, slope_v = slope_u * xx + slope_v * xy, slope_u * xy + slope_v * yy
    by_local = np.stack([slope_u / z, slope_v / z, -(slope_u * x + slope_v * y) / z**2], 1)
    ego_SE3_camera = invert_se3(image.chunk_SE3_ego) @ image.view.chunk_SE3_camera @ compose_motion(mount)
    in_ego = local @ ego_SE3_camera[:3, :3].T + ego_SE3_camera[:3, 3]
    by_ego = by_local @ ego_SE3_camera[:3, :3].T
    # When a camera moves, the point moves against it: by −ω × X − t.
    return np.concatenate([-np.cross(local, by_local), -by_local, -np.cross(in_ego, by_ego), -by_ego], 1)


def _robust_residual(brightness: Float64, seen: NDArray[np.bool_]) -> tuple[Float64, Float64]:
    """Differences [V, P] from each point's mean over views, and weights [V, P] that outliers have little of."""
    weight = seen.astype(np.float64)
    for _ in range(_REWEIGHTINGS):
        mean = (weight * brightness).sum(0) / np.maximum(weight.sum(0), _TINY)
        residual = np.where(seen, brightness - mean, 0.0)
        weight = seen / (1 + (residual / _OUTLIER) ** 2)
    return residual, weight


def _solve(
    slopes: Sequence[Float64],
    seen: NDArray[np.bool_],
    residual: Float64,
    weight: Float64,
    images: Sequence[AlignedImage],
    mounts: Float64,
    rig: Float64,
) -> tuple[Float64, Float64]:
    size = mounts.size + rig.size
    normal = np.zeros((size, size))
    right = np.zeros(size)
    by_point = np.zeros((seen.shape[1], size))
    for k, image in enumerate(images):
        start = mounts.size + 6 * image.rig
        unknowns = np.r_[6 * image.mount : 6 * image.mount + 6, start : start + 6]
        # Most points are seen by a few views only: the others have no slopes.
        rows = np.flatnonzero(seen[k])
        observed = slopes[k]
        weighted = observed * weight[k, rows, None]
        normal[np.ix_(unknowns, unknowns)] += multiply_transposed(weighted, observed)
        right[unknowns] += (weighted * residual[k, rows, None]).sum(0)
        by_point[np.ix_(rows, unknowns)] += weighted
    # The mean over views moves with the views: Schur complement of the points' own brightness.
    normal -= multiply_transposed(by_point / np.maximum(weight.sum(0), _TINY)[:, None], by_point)
    variance = _VARIANCE_OF_MEDIAN * np.median(np.abs(residual[weight > 0])) ** 2 + _TINY
    scale = _INDEPENDENT_SHARE / variance
    prior = _prior_precision(len(mounts), len(rig))
    present = np.concatenate([mounts.ravel(), rig.ravel()])
    step = np.linalg.solve(scale * normal + prior, -scale * right - prior @ present)
    return (
        mounts + step[: mounts.size].reshape(mounts.shape),
        rig + step[mounts.size :].reshape(rig.shape),
    )


def _prior_precision(camera_count: int, frame_count: int) -> Float64:
    """What is expected of the motions before any image is seen: [S, S] for all S unknowns."""

    def precision(turn_deg: float, shift_m: float) -> Float64:
        return np.r_[np.full(3, np.radians(turn_deg) ** -2), np.full(3, shift_m**-2)]

    # Of the rig the change from frame to frame is expected to be small: a vehicle does not shake as noise does.
    steps = np.diff(np.eye(frame_count), axis=0)
    rig = np.kron(np.eye(frame_count), np.diag(precision(TURN_PRIOR_DEG, RIG_SHIFT_PRIOR_M)))
    rig += np.kron(steps.T @ steps, np.diag(precision(TURN_STEP_PRIOR_DEG, SHIFT_STEP_PRIOR_M)))
    mounts = np.diag(np.tile(precision(TURN_PRIOR_DEG, SHIFT_PRIOR_M), camera_count))
    return block_diag(mounts, rig)
