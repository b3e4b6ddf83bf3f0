"""Refuses what no image can be rendered of, with the numbers that are wrong, before any memory is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flows.simulators.image_request import ActorPose, ImageRequest, RenderLimits
from genre_tasks.errors import InputError
from genre_tasks.logs.lens_validity import find_distortion_faults
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.transforms import is_rigid_transform

MAX_READOUT_S = 1.0
"""Slower than this no camera reads an image out."""

MAX_PIXELS = 64_000_000
"""Of all images of one call; a single image is bounded by its sides."""

MAX_ACTORS = 1000
"""Actors of one image."""

_MAX_HALF_ANGLE_DEG = 80.0
# A telephoto lens of 0.6° to a side; a longer one is a mistaken unit.
_MAX_FOCAL_PER_SIDE = 50.0
# Principal points of cropped images lie outside, but not so far.
_MAX_CENTER_PER_SIDE = 3.0
_MAX_MOVE_M = 100.0
_MAX_DISTANCE_M = 10_000.0
# Poses from JSON may be those of a simulator that computes in single precision.
_ROTATION_TOLERANCE = 1e-3


def check_batch(requests: Sequence[ImageRequest], limits: RenderLimits) -> None:
    """Checks that a call asks for no more than memory has room for.

    Args:
        requests: of a client.
        limits: of one call.

    Raises:
        InputError: there are too many images, or too many pixels in them.
    """
    if len(requests) > limits.max_batch:
        raise InputError(f"{len(requests)} images in one request are too many", remedy=f"Ask for {limits.max_batch}.")
    pixels = sum(request.lens.width_px * request.lens.height_px for request in requests)
    if len(requests) > 1 and pixels > MAX_PIXELS:
        raise InputError(
            f"{pixels / 1e6:.0f} megapixels in one request are too many",
            remedy=f"Ask for {MAX_PIXELS / 1e6:.0f} at a time.",
        )


def check_request(request: ImageRequest, limits: RenderLimits, positions: Float64) -> None:
    """Checks one image's lens, poses and times, apart from whether the run has its moment and actors.

    Args:
        request: of a client.
        limits: of an image's size.
        positions: [F, 3] of the recorded vehicle, in the log's world.

    Raises:
        InputError: a value is not finite, of another shape or out of bounds.
    """
    check_lens(request.lens, limits)
    _check_times(request)
    start = check_pose(request.start_world_SE3_camera, "the camera at the start")
    end = check_pose(request.end_world_SE3_camera, "the camera at the end")
    _check_move(start, end, "the camera")
    distance_m = float(np.linalg.norm(positions - start[:3, 3], axis=1).min())
    if distance_m > _MAX_DISTANCE_M:
        raise InputError(
            f"the camera is {distance_m / 1000:.6g} km away from the recorded path",
            remedy=f"Give poses in the log's world, within {_MAX_DISTANCE_M / 1000:g} km.",
        )
    if request.actors is not None:
        _check_actors(request.actors)
    if request.recorded_actors and request.start_s != request.end_s:
        remedy = "Give poses of all actors where rows are read one after the other."
        raise InputError("recorded actors cannot stand next to placed ones during a readout", remedy=remedy)


def check_lens(lens: Lens, limits: RenderLimits) -> None:
    """Checks that an image of a lens has a sensible size and that the renderer can take the lens.

    Args:
        lens: of a client.
        limits: of an image's size.

    Raises:
        InputError: it is out of bounds.

    >>> check_lens(Lens(50.0, 50.0, 32.0, 24.0, 64, 48), RenderLimits(max_width_px=32))
    Traceback (most recent call last):
    genre_tasks.errors.InputError: an image of 64 × 48 px is out of bounds. Ask for 1 × 1 to 32 × 1280 px.
    """
    width = lens.width_px
    height = lens.height_px
    if not (1 <= width <= limits.max_width_px and 1 <= height <= limits.max_height_px):
        raise InputError(
            f"an image of {width} × {height} px is out of bounds",
            remedy=f"Ask for 1 × 1 to {limits.max_width_px} × {limits.max_height_px} px.",
        )
    for axis, focal_px, center_px, side in (
        ("x", lens.fx_px, lens.cx_px, width),
        ("y", lens.fy_px, lens.cy_px, height),
    ):
        if not (math.isfinite(focal_px) and math.isfinite(center_px)):
            problem = f"the lens is not finite: f{axis} {focal_px:g}, c{axis} {center_px:g} px"
            raise InputError(problem, remedy="Give finite numbers.")
        # Of half the image: the widest that a pinhole's linearised projection is good for.
        shortest_px = side / 2 / math.tan(math.radians(_MAX_HALF_ANGLE_DEG))
        longest_px = _MAX_FOCAL_PER_SIDE * max(width, height)
        if not shortest_px <= focal_px <= longest_px:
            raise InputError(
                f"a focal length f{axis} of {focal_px:g} px is out of bounds for {width} × {height} px",
                remedy=f"Give {shortest_px:.4g} to {longest_px:.6g} px.",
            )
        if abs(center_px - side / 2) > _MAX_CENTER_PER_SIDE * side:
            raise InputError(
                f"a principal point c{axis} of {center_px:g} px is far outside of {width} × {height} px",
                remedy="Give pixels from the upper left corner of the image.",
            )
    for finding in find_distortion_faults(lens):
        if finding.severity == "fatal":
            raise InputError(finding.message, remedy=finding.remedy)


def check_pose(pose: Float64, subject: str) -> Float64:
    """Checks that a matrix is a rigid transform.

    Args:
        pose: of a client.
        subject: what the error calls it.

    Returns:
        [4, 4] float64.

    Raises:
        InputError: it has another shape, or is not finite, or turns and scales.

    >>> check_pose(np.eye(4), "the camera").shape
    (4, 4)
    """
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (4, 4):
        shape = " × ".join(str(size) for size in matrix.shape)
        raise InputError(f"the pose of {subject} has the shape {shape or 'of a number'}", remedy="Give 4 × 4 numbers.")
    if not np.isfinite(matrix).all():
        raise InputError(f"the pose of {subject} is not finite", remedy="Give 4 × 4 finite numbers.")
    if np.abs(matrix).max() > 1e9 or np.abs(matrix[3] - (0, 0, 0, 1)).max() > _ROTATION_TOLERANCE:
        row = ", ".join(f"{value:g}" for value in matrix[3])
        raise InputError(
            f"the pose of {subject} is no rigid transform; its last row is {row}",
            remedy="Give metres, and 0, 0, 0, 1 in the last row.",
        )
    if not is_rigid_transform(matrix, _ROTATION_TOLERANCE):
        raise InputError(
            f"the pose of {subject} is no rigid transform; its determinant is {np.linalg.det(matrix[:3, :3]):.4g}",
            remedy="Give a rotation matrix without scale or reflection.",
        )
    return matrix


def _check_times(request: ImageRequest) -> None:
    if not (math.isfinite(request.start_s) and math.isfinite(request.end_s)):
        raise InputError(
            f"the times {request.start_s:g} and {request.end_s:g} s are not finite", remedy="Give finite seconds."
        )
    readout_s = request.end_s - request.start_s
    if not 0 <= readout_s <= MAX_READOUT_S:
        raise InputError(
            f"a readout of {readout_s:g} s is out of bounds",
            remedy=f"Give an end at most {MAX_READOUT_S:g} s after the start.",
        )


def _check_move(start: Float64, end: Float64, subject: str) -> None:
    moved_m = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
    if moved_m > _MAX_MOVE_M:
        raise InputError(
            f"{subject} moves by {moved_m:.6g} m within one image",
            remedy=f"Give poses at its start and end, at most {_MAX_MOVE_M:g} m apart.",
        )


def _check_actors(actors: Sequence[ActorPose]) -> None:
    if len(actors) > MAX_ACTORS:
        raise InputError(f"{len(actors)} actors are too many for one image", remedy=f"Give at most {MAX_ACTORS}.")
    for actor in actors:
        start = check_pose(actor.start_world_SE3_box, f"actor {actor.track_id!r} at the start")
        end = check_pose(actor.end_world_SE3_box, f"actor {actor.track_id!r} at the end")
        _check_move(start, end, f"actor {actor.track_id!r}")
