"""The edges of a camera's images and of the LiDAR points that they show, on one grid of angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.edge_agreement import (
    Agreement,
    AngularGrid,
    correlate_edges,
    find_image_edges,
    find_range_edges,
    score_turns,
)
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_conventions import find_measurable
from genre_tasks.logs.types import Camera, Float32, Float64, Lens
from genre_tasks.scene.transforms import is_rigid_transform

FEW_IMAGES = 3
"""Images of a camera that are compared at first, spread over the chunk."""

_PIXELS_PER_DEG = 4.0
_WIDTH_RANGE_PX = (160, 400)
# Coarser images have no edges of their own at the scale of the grid.
MIN_PIXELS_PER_DEG = 2.0
_MIN_GRID = (40, 60)
# LiDAR edges of an image on average: fewer give no verdict.
_MIN_EDGES = 100
# Spread of the contrast of an image's edges: in the dark there is noise in place of edges.
_MIN_CONTRAST = 0.3

Edit = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]


@dataclass(frozen=True)
class CameraView:
    """What is compared for one camera.

    Attributes:
        camera: the camera.
        lens: of the images at the size at which they are compared.
        grid: of its directions.
        points: by frame, [N, 3] metres in camera axes.
        image_edges: by frame, [H, W].
    """

    camera: Camera
    lens: Lens
    grid: AngularGrid
    points: dict[int, Float64]
    image_edges: dict[int, Float32]

    @cached_property
    def range_edges(self) -> dict[int, Float32]:
        """By frame, [H, W]."""
        return {frame: find_range_edges(points, self.grid) for frame, points in self.points.items()}

    @property
    def few_frames(self) -> tuple[int, ...]:
        """Some of the frames, for what is tried many times."""
        frames = tuple(self.points)
        return frames[:: max(1, round(len(frames) / FEW_IMAGES))]

    @property
    def has_edges(self) -> bool:
        """Whether there is enough to compare."""
        if not self.points:
            return False
        counts = [(edges > 1).sum() for edges in self.range_edges.values()]
        contrast = [edges[edges != 0].std() for edges in self.image_edges.values() if edges.any()]
        # Half of the images may well be of a wall.
        return bool(np.mean(counts) >= _MIN_EDGES and contrast and np.median(contrast) >= _MIN_CONTRAST)


def view_camera(
    sample: LogSample, camera: Camera, images: int, min_pixels_per_deg: float = MIN_PIXELS_PER_DEG
) -> CameraView | None:
    """Reads images of a camera and the sweeps of their frames.

    Args:
        sample: the frames of a chunk.
        camera: one of its cameras.
        images: how many are read at most, spread over the chunk.
        min_pixels_per_deg: coarser images are not compared.

    Returns:
        Their edges and points; ``None`` where there are too few of either.
    """
    lens = camera.lens
    numbers = (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion)
    if not np.isfinite(numbers).all() or lens.fx_px <= 0 or lens.fy_px <= 0:
        return None
    field_deg = np.rad2deg(np.arctan(lens.cx_px / lens.fx_px) + np.arctan((lens.width_px - lens.cx_px) / lens.fx_px))
    if not 0 < field_deg * min_pixels_per_deg <= lens.width_px:
        return None
    width_px = int(np.clip(field_deg * _PIXELS_PER_DEG, *_WIDTH_RANGE_PX))
    lens = lens.resized_to_width(min(width_px, lens.width_px))
    grid = AngularGrid.of_lens(lens)
    if grid.shape[0] < _MIN_GRID[0] or grid.shape[1] < _MIN_GRID[1]:
        return None
    view = CameraView(camera, lens, grid, {}, {})
    poses = sample.world_SE3_camera(camera)
    for index in np.unique(np.linspace(0, len(sample.frames) - 1, images).round().astype(int)):
        frame = sample.frames[index]
        edges = read_image_edges(sample, view, camera, frame)
        sweep = sample.sweep(frame)
        if edges is None or sweep is None or not is_rigid_transform(poses[index]):
            continue
        # By einsum: a matrix product would start threads for a matrix of three columns.
        offset = sweep.points_world[find_measurable(sweep.points_world)] - poses[index, :3, 3]
        view.points[frame] = np.einsum("ni,ij->nj", offset, poses[index, :3, :3])
        view.image_edges[frame] = edges
    return view if view.has_edges else None


def read_image_edges(
    sample: LogSample,
    view: CameraView,
    camera: Camera,
    frame: int,
    edit: Edit | None = None,
    lens: Lens | None = None,
) -> Float32 | None:
    """Finds the edges of an image as if it were one of the view's camera.

    Args:
        sample: the frames of a chunk.
        view: of the camera.
        camera: whose image it is.
        frame: of the image.
        edit: changes the pixels first, if any.
        lens: in place of the view's, for an image of its size.

    Returns:
        [H, W] on the view's grid; ``None`` where the image cannot be read.
    """
    pixels = sample.pixels(camera, frame, view.lens.width_px)
    if pixels is None or pixels.shape[:2] != (view.lens.height_px, view.lens.width_px):
        return None
    return find_image_edges(pixels if edit is None else edit(pixels), lens or view.lens, view.grid)


def score_edges(range_edges: dict[int, Float32], image_edges: dict[int, Float32]) -> Agreement | None:
    """Scores how well edges agree over all images.

    Args:
        range_edges: by frame, [H, W].
        image_edges: by frame, [H, W]; of some of these frames.

    Returns:
        The scores; ``None`` without edges.
    """
    surfaces = [correlate_edges(range_edges[frame], edges) for frame, edges in image_edges.items()]
    return score_turns(np.sum(surfaces, axis=0)) if surfaces else None
