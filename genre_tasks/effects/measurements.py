"""What the effects measure on a chunk, each computed once: images, LiDAR returns in images, colours of points."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.point_colors import (
    GainEstimate,
    PointColors,
    estimate_gains_and_haze,
    find_linked_views,
    sample_log_colors,
    srgb_to_linear_above_toe,
)
from genre_tasks.logs.types import Camera, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.pose_alignment import PoseAlignment, align_poses
from genre_tasks.scene.projection import Projected, project
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene.visibility import find_visible_points
from genre_tasks.threads import map_single_threaded

IMAGES_OVER_TIME = 10
"""About so many images of each camera are compared over time."""

# From one place, road is as still as the recording vehicle. The slow start of PandaSet 002 has steps of 0.15 m.
SAME_PLACE_M = 0.1
"""Where two images that follow were taken nearer to one another, the vehicle stands for a part of the chunk."""

IMAGE_STEP_M = 0.3
"""There, images that are compared over time were taken so far apart at least."""

SAMPLE_COUNT = 6000
"""Static points whose colours are compared between images."""

# A farther point is smaller than a pixel, whose colour is then that of the neighbourhood.
SAMPLE_RANGE_M = 25.0
"""Points are sampled up to this distance from the path, and from a camera."""

# Haze is as bright as the sky, which this quantile of the images' colours stands for.
_SKY_QUANTILE = 0.9


class ChunkMeasurements:
    """A chunk, its cameras, and what several effects measure on them.

    Every property is computed when an effect first asks for it, so that a chunk whose effects are off costs nothing.

    Attributes:
        chunk: the chunk.
        ingested: the same chunk as ``ingest`` made it, at the poses that its points were coloured at.
        cameras: the log's cameras that the chunk uses, by name.
    """

    def __init__(self, chunk: Chunk, cameras: Sequence[Camera], ingested: Chunk | None = None) -> None:
        """Takes a chunk and the cameras of its log.

        Args:
            chunk: the chunk to measure.
            cameras: of the log; those that the chunk does not use are left out.
            ingested: the chunk at the poses that its points were coloured at; ``None``: the same.
        """
        self.chunk = chunk
        self.ingested = chunk if ingested is None else ingested
        self.cameras = {c.name: c for c in cameras if c.name in chunk.camera_names}

    @cached_property
    def source_views(self) -> tuple[View, ...]:
        """The source views."""
        return self.chunk.views_with_role("source")

    @cached_property
    def source_images(self) -> dict[tuple[str, int], NDArray[np.uint8]]:
        """By camera and frame, the source images at the working resolution, [H, W, 3]."""
        return {(v.camera, v.frame): self.decode_view(v) for v in self.source_views}

    def decode_view(self, view: View) -> NDArray[np.uint8]:
        """Decodes a view's image at the working resolution.

        Args:
            view: of the chunk.

        Returns:
            [H, W, 3] sRGB.

        Raises:
            InputError: the image cannot be decoded.
        """
        # Not cached: ``source_images`` keeps those that several effects share, all others would fill the memory.
        return decode_pixels(view.image, view.lens.width_px, view.lens.height_px)

    @cached_property
    def images_over_time(self) -> dict[str, NDArray[np.uint8]]:
        """By camera, [F, H, W, 3]: images spread over the chunk, of different places; held-out ones too."""
        images_by_camera = {}
        for camera in self.chunk.camera_names:
            # Held-out images may take part: a mask takes nothing of the scene from them.
            views = [v for v in self.chunk.views if v.camera == camera]
            images = [self.decode_view(v) for v in _select_views_over_time(views)]
            # A camera without images has an empty array, so that callers only ask for its length.
            images_by_camera[camera] = np.stack(images) if images else np.zeros((0, 1, 1, 3), np.uint8)
        return images_by_camera

    @cached_property
    def coarse_alignment(self) -> PoseAlignment | None:
        """Coarsely refined poses, which tell whether poses err; ``None`` where no two views see the same points."""
        return align_poses(self.chunk, coarse=True)

    @cached_property
    def lidar_returns(self) -> list[Projected]:
        """For each source view, the static LiDAR returns of its own frame that fall into its image."""
        static = self.chunk.static
        return [
            project(static.positions[static.frames == v.frame], v.chunk_SE3_camera, v.lens) for v in self.source_views
        ]

    @cached_property
    def point_colors(self) -> PointColors:
        """Colours of up to ``SAMPLE_COUNT`` static points near the path, in all source images that see them."""
        static = self.chunk.static
        usable = static.frames >= 0
        usable &= static.colored & (distance_to_path(static.positions, self.chunk.chunk_SE3_ego) < SAMPLE_RANGE_M)
        candidates = np.flatnonzero(usable)
        # The seed is fixed because the plan is an input of later stages: the same chunk must give the same plan.
        sample_size = min(SAMPLE_COUNT, len(candidates))
        sample = np.sort(np.random.default_rng(0).choice(candidates, sample_size, replace=False))
        column_of_point = np.full(len(static), -1)
        column_of_point[sample] = np.arange(len(sample))
        log_color = np.full((len(self.source_views), len(sample), 3), np.nan)
        texture = np.full(log_color.shape[:2], np.nan)
        distance_m = np.zeros(log_color.shape[:2])
        # Before the threads, which would decode the images several times.
        images = self.source_images

        def sample_view(k: int) -> None:
            view = self.source_views[k]
            # All points take part in the occlusion test, not the sampled ones alone.
            index, uv, depth = find_visible_points(static.positions, view)
            # A point near the path may still be far away from this camera.
            sampled = np.flatnonzero((column_of_point.take(index) >= 0) & (depth < SAMPLE_RANGE_M))
            columns = column_of_point[index[sampled]]
            colors, contrast = sample_log_colors(images[view.camera, view.frame], uv[sampled])
            log_color[k, columns] = colors
            texture[k, columns] = contrast
            distance_m[k, columns] = depth[sampled]

        map_single_threaded(sample_view, range(len(self.source_views)))
        return PointColors(self.source_views, log_color, texture, distance_m)

    @cached_property
    def linked(self) -> NDArray[np.bool_]:
        """[V] true where a source image shares enough points with others for its gain to be known."""
        # Computed apart from the estimate, which cannot be made without any image.
        return find_linked_views(self.point_colors.shared)

    @property
    def log_gains(self) -> Float64:
        """[V, 3] log gain of each source image, of mean zero over those in :attr:`linked`."""
        return self._gain_estimate.log_gain

    @property
    def color_residuals(self) -> Float64:
        """[V, P, 3] log colours without point colour, gain and haze; NaN where a point is in one image alone."""
        return self._gain_estimate.residual

    @cached_property
    def _gain_estimate(self) -> GainEstimate:
        # Haze lightens what is far away. Left out, it would pass for gain, since one camera sees from afar what another
        # sees from nearby.
        colors = self.point_colors
        observed = colors.shared
        # A quantile needs no more than every sixteenth pixel.
        linear = [srgb_to_linear_above_toe(p[::4, ::4].reshape(-1, 3) / 255.0) for p in self.source_images.values()]
        sky_color = np.quantile(linear, _SKY_QUANTILE, (0, 1))
        # Zero instead of NaN: what is not observed has weight 0, and NaN times 0 would still be NaN.
        log_color = np.where(observed[..., None], colors.log_color, 0.0)
        return estimate_gains_and_haze(log_color, colors.distance_m, colors.texture, observed, sky_color)


def _select_views_over_time(views: Sequence[View]) -> list[View]:
    """About ``IMAGES_OVER_TIME`` of a camera's views, spread over time; none of a place where the vehicle stood."""
    spread = _spread_over_time(views)
    positions = np.array([view.chunk_SE3_camera[:3, 3] for view in spread]).reshape(-1, 3)
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if (steps_m >= SAME_PLACE_M).all():
        return spread
    # Chosen from all views: of the few that were taken on the move, every second one would be left out otherwise.
    apart: list[View] = []
    for view in views:
        distances_m = [np.linalg.norm((view.chunk_SE3_camera - other.chunk_SE3_camera)[:3, 3]) for other in apart]
        # From all of them: a vehicle may come back to a place.
        if min(distances_m, default=np.inf) >= IMAGE_STEP_M:
            apart.append(view)
    return _spread_over_time(apart)


def _spread_over_time(views: Sequence[View]) -> list[View]:
    return list(views[:: max(1, len(views) // IMAGES_OVER_TIME)])
