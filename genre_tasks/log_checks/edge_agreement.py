"""How well the edges of LiDAR points agree with those of images, for every small turn of the camera.

Where the range of LiDAR points jumps between neighbours, an image mostly has an edge (Levinson and Thrun, Automatic
Online Calibration of Cameras and Lasers, RSS 2013). Both are put on one grid of angles, on which a turn of the camera
is a shift, so that one correlation by FFT says how well each turn fits.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.lens_distortion import Reals, distort, fold_radius, undistort

CELL_DEG = 0.3
"""Side of a cell of the grid: LiDARs measure every 0.1° to 0.4°."""

MAX_YAW_DEG = 12.0
MAX_PITCH_DEG = 6.0

STRIPS = 3
"""Parts of an image, from left to right: a wrong focal length shifts its left and its right to opposite sides."""

# A jump of the range by 8 % is an edge; more than 23 % counts no more.
_JUMP = 0.08
_MAX_JUMP = 0.15
_MIN_DEPTH_M = 0.3
# Contrast is relative to what is around within so many cells: trees and façades would decide alone.
_CONTRAST_CELLS = 8.0
_MAX_CONTRAST = 3.0
# Of an 8-bit image under a square root: less is noise.
_NOISE = 0.02

# Cells on either side within which turns count as one: upright edges say less about pitch.
_YAW_BLUR = 2
_PITCH_BLUR = 3
# Cells on either side within which a turn is a matter of accuracy: cameras of a well-kept data set are off by 1.8°,
# where they and the LiDAR see near objects from different sides and at different times.
_TOLERANCE = 8
# Cells by which the left and the right of an image are shifted to opposite sides; two thirds of them lie between.
_MAX_STRETCH = 12
_MAX_SLOPE = 12
# Scores of sound logs are 5 to 40. Of a few edges most turns have none in common, and rounding alone would deviate.
_MAX_SCORE = 1000.0


@dataclass(frozen=True)
class AngularGrid:
    """The directions that a camera sees, in steps of ``CELL_DEG``.

    Attributes:
        azimuth_rad: [W] to the right of the camera's axis.
        elevation_rad: [H] downwards from the camera's horizontal plane.
    """

    azimuth_rad: Float64
    elevation_rad: Float64

    @classmethod
    def of_lens(cls, lens: Lens) -> AngularGrid:
        """Covers the image of a lens.

        Args:
            lens: of the camera.
        """
        u = np.array([0.0, lens.width_px, lens.cx_px, lens.cx_px])
        v = np.array([lens.cy_px, lens.cy_px, 0.0, lens.height_px])
        x: Reals = (u - lens.cx_px) / lens.fx_px
        y: Reals = (v - lens.cy_px) / lens.fy_px
        if any(lens.distortion):
            x, y = undistort(np.asarray(x, np.float64), np.asarray(y, np.float64), lens.coefficients)
        step = float(np.deg2rad(CELL_DEG))
        # A lens that is damaged sees nothing.
        left, right, top, bottom = np.nan_to_num(np.arctan([x[0], x[1], y[2], y[3]])).tolist()
        return cls(np.arange(left, right, step), np.arange(top, bottom, step))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (len(self.elevation_rad), len(self.azimuth_rad))


def find_image_edges(pixels: NDArray[np.uint8], lens: Lens, grid: AngularGrid) -> Float32:
    """Finds the upright edges of an image on a grid of angles.

    Args:
        pixels: [H, W, 3] sRGB.
        lens: of this image.
        grid: of the camera.

    Returns:
        Contrast to the surroundings, about 0 on average; 0 outside of the image.
    """
    from scipy import ndimage

    azimuth, elevation = np.meshgrid(grid.azimuth_rad, grid.elevation_rad)
    x: Reals = np.tan(azimuth)
    y: Reals = np.tan(elevation) / np.cos(azimuth)
    inside = np.ones(grid.shape, dtype=bool)
    if any(lens.distortion):
        inside &= x * x + y * y < fold_radius(lens.coefficients) ** 2
        x, y = distort(x, y, lens.coefficients)
    u = x * lens.fx_px + lens.cx_px
    v = y * lens.fy_px + lens.cy_px
    inside &= (u >= 0) & (u <= lens.width_px) & (v >= 0) & (v <= lens.height_px)
    # The root makes noise about equal in dark and bright parts.
    brightness = np.sqrt(pixels.mean(axis=2, dtype=np.float32))
    mapped = ndimage.map_coordinates(brightness, [v - 0.5, u - 0.5], order=1, mode="nearest", output=np.float32)
    slope = np.abs(ndimage.gaussian_filter(mapped, 1.0, order=(0, 1)))
    # The border of the image is no edge of what it shows.
    usable = ndimage.binary_erosion(inside, iterations=3)
    return _normalise_contrast(slope, usable)


def find_range_edges(points_camera: Float64, grid: AngularGrid) -> Float32:
    """Finds where the range of LiDAR points jumps from one azimuth to the next.

    Args:
        points_camera: [N, 3] metres, camera axes.
        grid: of the camera.

    Returns:
        Contrast to the surroundings, about 0 on average; 0 where there are no points.
    """
    from scipy import ndimage

    # A pinhole lens sees nothing beside itself or behind.
    points = points_camera[points_camera[:, 2] > _MIN_DEPTH_M].astype(np.float32)
    horizontal_m = np.hypot(points[:, 0], points[:, 2])
    step = np.float32(np.deg2rad(CELL_DEG))
    column = np.rint((np.arctan2(points[:, 0], points[:, 2]) - grid.azimuth_rad[0]) / step).astype(np.int64)
    row = np.rint((np.arctan2(points[:, 1], horizontal_m) - grid.elevation_rad[0]) / step).astype(np.int64)
    height, width = grid.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    ranges = np.full(height * width, np.inf, dtype=np.float32)
    np.minimum.at(ranges, row[inside] * width + column[inside], np.hypot(horizontal_m, points[:, 1])[inside])
    # Rings have gaps between them, and azimuths do now and then.
    closed = ndimage.minimum_filter(ranges.reshape(grid.shape), size=(3, 2))
    measured = np.isfinite(closed)
    log_range = np.log(np.where(measured, closed, 1.0))
    jump = np.zeros(grid.shape, dtype=np.float32)
    both = measured[:, 2:] & measured[:, :-2]
    difference = np.abs(log_range[:, 2:] - log_range[:, :-2]) - _JUMP
    jump[:, 1:-1] = np.where(both, np.clip(difference, 0, _MAX_JUMP), 0)
    return _normalise_contrast(jump, measured)


def _normalise_contrast(values: Float32, usable: NDArray[np.bool_]) -> Float32:
    """Subtracts the mean of the surroundings, and divides by their standard deviation."""
    from scipy import ndimage

    weight = ndimage.gaussian_filter(usable.astype(np.float32), _CONTRAST_CELLS) + 1e-6
    values = np.where(usable, values, 0)
    difference = np.where(usable, values - ndimage.gaussian_filter(values, _CONTRAST_CELLS) / weight, 0)
    deviation = np.sqrt(ndimage.gaussian_filter(difference**2, _CONTRAST_CELLS) / weight)
    return np.clip(difference / (deviation + _NOISE), -_MAX_CONTRAST, _MAX_CONTRAST).astype(np.float32)


def correlate_edges(range_edges: Float32, image_edges: Float32) -> Float32:
    """Correlates both for every shift within ``MAX_YAW_DEG`` and ``MAX_PITCH_DEG``.

    Args:
        range_edges: [H, W], see :func:`find_range_edges`.
        image_edges: [H, W], see :func:`find_image_edges`.

    Returns:
        [STRIPS, P, Y] sums of products, for the parts of the image from left to right; the middle is no shift, and
        indices rise with shifts of the points down and to the right.
    """
    from scipy import fft

    rows = int(MAX_PITCH_DEG / CELL_DEG)
    columns = int(MAX_YAW_DEG / CELL_DEG)
    height, width = range_edges.shape
    # Padded, or what leaves the image on one side would come back on the other.
    shape = (fft.next_fast_len(height + rows, True), fft.next_fast_len(width + columns, True))
    strips = np.zeros((STRIPS, height, width), dtype=np.float32)
    borders = np.linspace(0, width, STRIPS + 1).astype(int)
    for strip, (left, right) in enumerate(itertools.pairwise(borders)):
        strips[strip, :, left:right] = range_edges[:, left:right]
    product = fft.rfft2(image_edges, shape) * np.conj(fft.rfft2(strips, shape, axes=(1, 2)))
    surface = np.roll(fft.irfft2(product, shape, axes=(1, 2)), (rows, columns), axis=(1, 2))
    return np.asarray(surface[:, : 2 * rows + 1, : 2 * columns + 1], dtype=np.float32)


@dataclass(frozen=True)
class Turn:
    """A turn of the camera, and how well edges agree with it.

    Attributes:
        score: standard deviations above what chance gives.
        yaw_deg: the points to the right.
        pitch_deg: the points down.
    """

    score: float
    yaw_deg: float
    pitch_deg: float


@dataclass(frozen=True)
class Agreement:
    """How well edges agree, in standard deviations above what chance gives.

    Attributes:
        score: as the log has the camera, with the turns that the measurement cannot tell apart.
        near: the best turn within the accuracy of good calibrations, and of edges that are not quite the same.
        far: the best turn beyond.
        best_stretch: score of the best opposite shift of the image's left and right parts.
        stretch_deg: of that shift, the right part's points to the right and the left part's to the left.
        slope_deg: of that shift, the right part's points down and the left part's up.
    """

    score: float
    near: Turn
    far: Turn
    best_stretch: float
    stretch_deg: float
    slope_deg: float


def score_turns(surface: Float32) -> Agreement | None:
    """Compares the claimed pose of a camera with every other turn of it.

    Args:
        surface: [STRIPS, P, Y] sum over images of :func:`correlate_edges`.

    Returns:
        The scores; ``None`` where there are no edges, or so few that most turns have none in common.
    """
    total = surface.sum(axis=0)
    median = float(np.median(total))
    # By the median, which the peaks that are looked for hardly move.
    deviation = 1.4826 * float(np.median(np.abs(total - median)))
    if deviation * _MAX_SCORE <= float(np.abs(total - median).max()):
        return None
    row, column = total.shape[0] // 2, total.shape[1] // 2
    scores = (total - median) / deviation
    is_near = np.zeros(scores.shape, dtype=bool)
    is_near[row - _TOLERANCE : row + _TOLERANCE + 1, column - _TOLERANCE : column + _TOLERANCE + 1] = True
    stretched, stretch, slope = _find_best_stretch(surface, row, column)
    return Agreement(
        score=float(scores[_window(row, column)].max()),
        near=_find_best_turn(np.where(is_near, scores, -np.inf)),
        far=_find_best_turn(np.where(is_near, -np.inf, scores)),
        best_stretch=(stretched - median) / deviation,
        stretch_deg=stretch * CELL_DEG,
        slope_deg=slope * CELL_DEG,
    )


def _find_best_turn(scores: Float32) -> Turn:
    row, column = np.unravel_index(scores.argmax(), scores.shape)
    pitch_deg = float(row - scores.shape[0] // 2) * CELL_DEG
    return Turn(float(scores[row, column]), float(column - scores.shape[1] // 2) * CELL_DEG, pitch_deg)


def _window(row: int, column: int) -> tuple[slice, slice]:
    """Turns that the measurement cannot tell apart."""
    return (
        slice(row - _PITCH_BLUR, row + _PITCH_BLUR + 1),
        slice(column - _YAW_BLUR, column + _YAW_BLUR + 1),
    )


def _find_best_stretch(surface: Float32, row: int, column: int) -> tuple[float, int, int]:
    """Largest sum of the left part shifted one way, the right part the other; with the shift in cells."""
    best = (-np.inf, 0, 0)
    middle = surface[1][_window(row, column)]
    for stretch in range(-_MAX_STRETCH, _MAX_STRETCH + 1):
        for slope in range(-_MAX_SLOPE, _MAX_SLOPE + 1, 2):
            if stretch == 0 and slope == 0:
                continue
            left = surface[0][_window(row - slope, column - stretch)]
            right = surface[2][_window(row + slope, column + stretch)]
            best = max(best, (float((left + middle + right).max()), stretch, slope))
    return best
