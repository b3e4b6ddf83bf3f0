"""What a viewer draws beside the scene: the recorded path, the reliable range on the ground, and where cameras were."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.simulation.stored_ranges import SideRange
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import list_image_times, measure_frame_times
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.transforms import shift_laterally
from genre_tasks.scene_edits.ground import Ground

ABOVE_GROUND_M = 0.15
"""Lines on the ground are drawn this far above it, out of the Gaussians of the road."""

RUNG_M = 2.0
"""Distance of the lines across the reliable range."""

THUMBNAIL_PX = 192
"""Width of the recorded images in the viewer."""

MAX_IMAGE_FRAMES = 20
"""Recorded images are taken at no more frames than this, evenly spread, so that a long chunk stays small."""


@dataclass(frozen=True)
class PathDrawing:
    """The recorded path on the ground, in the chunk's coordinates.

    Attributes:
        points: [F, 3] metres, one for each frame.
        left: [F, 3] unit vectors to the left, horizontal.
    """

    points: Float64
    left: Float64

    def segments(self, shift_m: float = 0.0) -> Float32:
        """Gives a line along the path.

        Args:
            shift_m: metres to the left of it.

        Returns:
            [F − 1, 2, 3] its straight pieces.
        """
        points = self.points + shift_m * self.left
        return np.stack([points[:-1], points[1:]], 1).astype(np.float32)

    def range_segments(self, sides: SideRange) -> Float32:
        """Gives the lines that bound the reliable range, with rungs across it.

        Args:
            sides: how far it goes to the left and right.

        Returns:
            [S, 2, 3] straight pieces.
        """
        left = self.points + sides.left_m * self.left
        right = self.points - sides.right_m * self.left
        rungs = np.stack([left, right], 1)[self._rung_rows()].astype(np.float32)
        return np.concatenate([self.segments(sides.left_m), self.segments(-sides.right_m), rungs])

    def _rung_rows(self) -> NDArray[np.int64]:
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        distance = np.concatenate([[0.0], np.cumsum(steps)])
        # The first frame of each stretch of this length; both ends close the range.
        _, first = np.unique(np.floor(distance / RUNG_M), return_index=True)
        return np.unique(np.append(first, len(self.points) - 1))


@dataclass(frozen=True)
class CameraImage:
    """A recorded image and where it was taken.

    Attributes:
        camera: name of the camera.
        frame: log frame.
        chunk_SE3_camera: [4, 4], z forward, x right, y down.
        fov_rad: vertical field of view.
        aspect: width over height.
        pixels: [H, W, 3] uint8 sRGB.
    """

    camera: str
    frame: int
    chunk_SE3_camera: Float64
    fov_rad: float
    aspect: float
    pixels: NDArray[np.uint8]


def draw_path(chunk: Chunk) -> PathDrawing:
    """Puts a chunk's recorded path onto the ground.

    Args:
        chunk: with its LiDAR points and actors.

    Returns:
        The path, ``ABOVE_GROUND_M`` above the ground that LiDAR and traffic show.
    """
    poses = chunk.chunk_SE3_ego
    frames = np.asarray(chunk.frames, np.float64)
    path = EgoPath(measure_frame_times(frames, list_image_times(chunk)), frames, poses)
    bottoms = [_box_bottoms(actor.chunk_SE3_box, actor.size_m[2]) for actor in chunk.actors]
    ground = Ground.from_points(chunk.static.positions.astype(np.float64), path, bottoms)
    heights, _ = ground.measure(poses[:, :2, 3])
    points = np.concatenate([poses[:, :2, 3], heights[:, None] + ABOVE_GROUND_M], 1)
    left = np.stack([shift_laterally(np.eye(4), pose, 1.0)[:3, 3] for pose in poses])
    return PathDrawing(points, left)


def _box_bottoms(poses: Float64, height_m: float) -> Float64:
    return np.asarray(poses[:, :3, 3] - 0.5 * height_m * poses[:, :3, 2])


def list_image_frames(chunk: Chunk) -> tuple[int, ...]:
    """Lists the frames at which some camera has an image.

    Args:
        chunk: its cameras may be slower than its frames.

    Returns:
        Log frames, in order.
    """
    return tuple(sorted({view.frame for view in chunk.views}))


def select_image_frames(frames: tuple[int, ...]) -> tuple[int, ...]:
    """Selects the frames whose recorded images are shown.

    Args:
        frames: of a chunk, those with images.

    >>> select_image_frames((3, 4, 5)), len(select_image_frames(tuple(range(200))))
    ((3, 4, 5), 20)
    """
    rows = np.linspace(0, len(frames) - 1, min(len(frames), MAX_IMAGE_FRAMES)).round().astype(int)
    return tuple(frames[row] for row in rows)


def collect_images(chunk: Chunk) -> tuple[CameraImage, ...]:
    """Decodes small recorded images.

    Args:
        chunk: whose images.

    Returns:
        Images in the order of frames and cameras, at the frames of :func:`select_image_frames`; none where the chunk
        has none.

    Raises:
        InputError: an image cannot be decoded.
    """
    selected = set(select_image_frames(list_image_frames(chunk)))
    return tuple(_read_image(view) for view in chunk.views if view.frame in selected)


def measure_fov(lens: Lens) -> tuple[float, float]:
    """Measures a lens as a viewer states it.

    Args:
        lens: its principal point counts as the middle of the image.

    Returns:
        Vertical field of view in radians, and width over height at equal focal lengths.

    >>> fov_rad, aspect = measure_fov(Lens(50.0, 50.0, 50.0, 25.0, 100, 50))
    >>> round(math.degrees(fov_rad)), aspect
    (53, 2.0)
    """
    fov_rad = 2 * math.atan(lens.height_px / (2 * lens.fy_px))
    return fov_rad, (lens.width_px / lens.fx_px) / (lens.height_px / lens.fy_px)


def _read_image(view: View) -> CameraImage:
    lens = view.lens.resized_to_width(min(THUMBNAIL_PX, view.lens.width_px))
    fov_rad, aspect = measure_fov(view.lens)
    pixels = decode_pixels(view.image, lens.width_px, lens.height_px)
    return CameraImage(view.camera, view.frame, view.chunk_SE3_camera, fov_rad, aspect, pixels)
