"""Camera poses refined such that LiDAR points have one colour in all images that see them.

Direct bundle adjustment (Engel, Koltun and Cremers 2018) with the LiDAR's geometry: the brightness of a point in each
image is compared with its mean over images. Two small rigid motions explain the differences: one of each camera's
mount, which is the same at all times, and one of the whole rig at each frame. Priors keep both near zero, which also
fixes what images cannot tell, such as a motion of everything. Frames in between take the rig's motion from their
neighbours in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.alignment_step import (
    AlignedImage,
    ImageSlopes,
    compute_pose,
    move_pose,
    project_points,
    take_step,
)
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene.visibility import find_visible_points
from genre_tasks.srgb import LUMA_WEIGHTS
from genre_tasks.threads import map_single_threaded

BLURS_PX = (4.0, 2.0, 1.0, 0.6)
"""Standard deviations by which images are blurred, one after the other: a coarse image leads over larger errors."""

COARSE_BLURS_PX = (4.0, 2.0)
"""The same where it is only asked whether poses err at all."""

ITERATIONS = 10
"""Gauss–Newton steps at each blur, at most."""

SMALLEST_STEP = 1e-4
"""Steps end where no motion changes by more than this, in radians and metres: a hundredth of a pixel."""

POINT_COUNT = 40_000
"""Points whose colours are compared; those with more texture are drawn more often."""

COARSE_POINT_COUNT = 10_000
"""The same where it is only asked whether poses err at all."""

MAX_RANGE_M = 40.0
"""Points are drawn up to this distance from the path."""

MAX_WIDTH_PX = 1280
"""Images are compared at twice the working width, and at most at this one."""

MAX_PIXELS = 16_000_000
"""Of all images together, which bounds the memory of long chunks with many cameras."""

MAX_OBSERVATIONS = 1_200_000
"""Points times images, for the same reason: more images have fewer points each."""

# The mean and contrast that are taken away are those of a neighbourhood so many times as wide as the blur.
_SURROUND = 5.0
_CONTRAST_FLOOR = 4e-4
# Cameras of a rig fire within a frame; further from their frame's mean is a clock that is wrong.
_MOST_OFFSET_S = 1.0


@dataclass(frozen=True)
class PoseAlignment:
    """Refined poses of a chunk's cameras.

    Attributes:
        poses: chunk_SE3_camera [4, 4] of each view, by camera and frame.
        displacement_px: by how many pixels of the working resolution LiDAR returns move in their image; the median of
            each source view, and the mean of those.
        mounts: [C, 6] turn (radians) and shift (metres) of each camera, in its own axes.
        rig: [F, 6] the same of the rig at each source frame, in the LiDAR's axes.
    """

    poses: dict[tuple[str, int], Float64]
    displacement_px: float
    mounts: Float64
    rig: Float64


def align_poses(chunk: Chunk, *, coarse: bool = False, start: PoseAlignment | None = None) -> PoseAlignment | None:
    """Refines the camera poses of a chunk. Deterministic.

    Args:
        chunk: with LiDAR points and source views.
        coarse: take fewer points and stop at a larger blur, which tells whether poses err in a third of the time.
        start: coarse motions to go on from, which spare the largest blur.

    Returns:
        The poses of all views; ``None`` where no two source views see the same points.

    Raises:
        InputError: an image cannot be decoded.
    """
    images = _load_images(chunk)
    motions = _find_motions(chunk, images, coarse, start)
    if motions is None:
        return None
    mounts, rig = motions
    poses = _interpolate(chunk, images, mounts, rig)
    return PoseAlignment(poses, _measure_displacement(chunk, poses), mounts, rig)


def _find_motions(
    chunk: Chunk, images: Sequence[AlignedImage], coarse: bool, start: PoseAlignment | None
) -> tuple[Float64, Float64] | None:
    """Motions of the mounts [C, 6] and of the rig [F, 6]; ``None`` where no two views see the same points."""
    frame_count = 1 + max((image.rig for image in images), default=-1)
    mounts = np.zeros((len(chunk.camera_names), 6)) if start is None else start.mounts
    rig = np.zeros((frame_count, 6)) if start is None else start.rig
    near = distance_to_path(chunk.static.positions, chunk.chunk_SE3_ego) < MAX_RANGE_M
    usable = near & (chunk.static.frames >= 0)
    point_count = min(COARSE_POINT_COUNT if coarse else POINT_COUNT, MAX_OBSERVATIONS // max(len(images), 1))
    blurs_px = COARSE_BLURS_PX if coarse else BLURS_PX
    for blur_px in blurs_px if start is None else blurs_px[1:]:
        levels = map_single_threaded(partial(_normalise, blur_px=blur_px), [image.luma for image in images])
        # Anew at each blur: what hides what follows from poses, which are better by now.
        moved = [replace(image.view, chunk_SE3_camera=compute_pose(image, mounts, rig)) for image in images]
        visible = map_single_threaded(partial(_find_visible, chunk.static.positions), moved)
        points, observed = _draw_points(chunk.static.positions, usable, visible, images, levels, point_count)
        if not observed.any():
            return None
        for _ in range(ITERATIONS):
            before = np.concatenate([mounts, rig])
            stepped = take_step(points, observed, images, levels, mounts, rig)
            # All points that views see may lie at the very border of the images, where they cannot be compared.
            if stepped is None:
                return None
            mounts, rig = stepped
            if np.abs(np.concatenate([mounts, rig]) - before).max() < SMALLEST_STEP:
                break
    return mounts, rig


def _find_visible(positions: Float32, view: View) -> tuple[NDArray[np.int64], Float32]:
    """Indices [M] of the points that a view sees, and their pixels [M, 2]."""
    index, uv, _ = find_visible_points(positions, view)
    return index, uv


def _load_images(chunk: Chunk) -> list[AlignedImage]:
    views = chunk.views_with_role("source")
    frames = sorted({view.frame for view in views})
    fitting_px = (MAX_PIXELS / max(len(views), 1) * chunk.width_px / chunk.height_px) ** 0.5
    width_px = min(2 * chunk.width_px, MAX_WIDTH_PX, round(fitting_px))
    weights = np.array(LUMA_WEIGHTS, np.float32)
    images = []
    for view in views:
        lens = view.lens.resized_to_width(width_px)
        luma = decode_pixels(view.image, lens.width_px, lens.height_px).astype(np.float32) @ weights / np.float32(255)
        ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
        mount = chunk.camera_names.index(view.camera)
        images.append(AlignedImage(view, lens, luma, ego, mount, frames.index(view.frame)))
    return images


def _normalise(luma: Float32, blur_px: float) -> ImageSlopes:
    # Without local mean and contrast, so that exposure and white balance make no difference.
    blurred = gaussian_filter(luma, blur_px)
    mean = _average_surround(luma, blur_px)
    variance = _average_surround((luma - mean) ** 2, blur_px)
    brightness = (blurred - mean) / np.sqrt(variance + np.float32(_CONTRAST_FLOOR))
    by_v, by_u = np.gradient(brightness)
    return ImageSlopes(brightness, by_u, by_v)


def _average_surround(values: Float32, blur_px: float) -> Float32:
    """Means over a neighbourhood: a box taken twice, near a Gaussian that would take ten times as long."""
    # Two boxes of this width have the variance of the Gaussian. It is odd: a box of even width has no pixel at its
    # centre, and each pass would move the image by half a pixel.
    width_px = 2 * round(((6 * (_SURROUND * blur_px) ** 2 + 1) ** 0.5 - 1) / 2) + 1
    averaged: Float32 = uniform_filter(uniform_filter(values, width_px), width_px)
    return averaged


def _draw_points(
    positions: Float32,
    usable: NDArray[np.bool_],
    visible: Sequence[tuple[NDArray[np.int64], Float32]],
    images: Sequence[AlignedImage],
    levels: Sequence[ImageSlopes],
    point_count: int,
) -> tuple[Float64, NDArray[np.bool_]]:
    """Points [P, 3] that at least two views see, and which of the V views see them [V, P]."""
    count = np.zeros(len(positions), np.int64)
    slope = np.zeros(len(positions), np.float32)

    for image, level, (index, uv) in zip(images, levels, visible, strict=True):
        count[index] += 1
        # A point's pixel is known from the look-up: here it only has to be found at the width of the comparison.
        column, row = (uv * np.float32(image.lens.width_px / image.view.lens.width_px)).astype(np.int64).T
        row = row.clip(0, image.lens.height_px - 1)
        column = column.clip(0, image.lens.width_px - 1)
        slope[index] = np.maximum(slope[index], np.hypot(level.by_u[row, column], level.by_v[row, column]))
    candidates = np.flatnonzero(usable & (count >= 2) & (slope > 0))
    chosen = np.empty(0, np.int64)
    if len(candidates):
        # A fixed seed: the poses are an input of later stages, and the same chunk must have the same.
        weights = slope[candidates].astype(np.float64)
        size = min(point_count, len(candidates))
        rng = np.random.default_rng(0)
        chosen = np.sort(rng.choice(candidates, size, replace=False, p=weights / weights.sum()))
    column = np.full(len(positions), -1)
    column[chosen] = np.arange(len(chosen))
    observed = np.zeros((len(images), len(chosen)), bool)
    for k, (index, _) in enumerate(visible):
        observed[k, column[index][column[index] >= 0]] = True
    return positions[chosen].astype(np.float64), observed


def _interpolate(
    chunk: Chunk, images: Sequence[AlignedImage], mounts: Float64, rig: Float64
) -> dict[tuple[str, int], Float64]:
    """Moves all views; those between source frames take the rig's motion from both neighbours in time."""
    times = np.array([np.mean([i.view.timestamp_s for i in images if i.rig == k]) for k in range(len(rig))])
    offsets_s = np.array([abs(i.view.timestamp_s - times[i.rig]) for i in images])
    # A clock that goes back, stands, or is another camera's would give a view the motion of another frame.
    is_by_time = bool((np.diff(times) > 0).all() and (offsets_s <= _MOST_OFFSET_S).all())
    frames = np.array([next(i.view.frame for i in images if i.rig == k) for k in range(len(rig))], np.float64)
    knots = times if is_by_time else frames
    poses = {}
    for view in chunk.views:
        moment = view.timestamp_s if is_by_time else float(view.frame)
        at_time = np.array([np.interp(moment, knots, rig[:, k]) for k in range(6)])
        ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
        mount = mounts[chunk.camera_names.index(view.camera)]
        poses[view.camera, view.frame] = move_pose(view.chunk_SE3_camera, ego, mount, at_time)
    return poses


def _measure_displacement(chunk: Chunk, poses: dict[tuple[str, int], Float64]) -> float:
    medians = []
    for view in chunk.views_with_role("source"):
        returns = chunk.static.positions[chunk.static.frames == view.frame].astype(np.float64)
        _, u, v, inside = project_points(returns, view.chunk_SE3_camera, view.lens)
        _, moved_u, moved_v, still_inside = project_points(returns, poses[view.camera, view.frame], view.lens)
        both = inside & still_inside
        if both.any():
            medians.append(float(np.median(np.hypot(moved_u - u, moved_v - v)[both])))
    return float(np.mean(medians)) if medians else 0.0
