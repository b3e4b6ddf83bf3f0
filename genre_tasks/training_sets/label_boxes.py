"""Images of a log, recorded or rendered, with the boxes that its annotation gives them.

Boxes stand where the annotation has them at the image's frame, which is where a scene is rendered with them. What a
moving object moves between the sweep and the image is left out.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, DrivingLog, Float32, Float64
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.transforms import invert_se3, shift_laterally
from genre_tasks.training_sets.box_outlines import (
    box_corners,
    find_boxes_in_view,
    measure_occlusion,
    outline_box,
)
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage

NO_SWEEP_POINTS = -1
"""What ``lidar_points`` is where the frame has no sweep."""

# A chunk has twenty frames, and neighbours share some.
_CACHED_FRAMES = 64
# Two: whoever compares logs goes from one to the next.
_CACHED_LOGS = 2


@dataclass(frozen=True)
class _FrameBoxes:
    """The boxes of a frame: tracks, poses [B, 4, 4], sizes [B, 3], velocities [B, 3] in the world, points [B]."""

    tracks: tuple[CuboidTrack, ...]
    world_SE3_box: Float64
    size_m: Float64
    world_velocity_m_s: Float64
    lidar_points: NDArray[np.int64]


class LogLabeller:
    """Labels images of one log; what belongs to a frame is computed once.

    Args:
        log: with annotations.

    Raises:
        InputError: the log has no annotations, or they cannot be read.
    """

    def __init__(self, log: DrivingLog) -> None:
        self.log = log
        self._tracks = log.tracks()
        if not self._tracks:
            remedy = "Choose a log with boxes: labels are made from them."
            raise InputError("the log has no annotations", remedy=remedy, log=log.uri)
        self._velocities = [_velocities(track, log) for track in self._tracks]
        self._frames: OrderedDict[int, _FrameBoxes] = OrderedDict()

    def label_recorded_image(self, chunk: Chunk, view: View, depth: Float32 | None = None) -> LabelledImage:
        """Decodes a recorded image at the chunk's working resolution and labels it.

        Args:
            chunk: of this log.
            view: of the chunk.
            depth: [H, W] metres of a scene rendered at the view's pose, which tells what is hidden; ``None``: unknown.

        Returns:
            The image with its boxes.

        Raises:
            InputError: the image cannot be decoded, or the sweep cannot be read.
        """
        try:
            image = decode_pixels(view.image, view.lens.width_px, view.lens.height_px)
        except InputError as error:
            # Decoding knows the bytes alone.
            where = {"log": chunk.log, "camera": view.camera, "frame": view.frame}
            raise InputError(error.problem, remedy=error.remedy, **where) from error  # type: ignore[arg-type]
        return self.label_view(chunk, view, image, shift_m=0.0, rendered=False, depth=depth)

    def label_view(
        self,
        chunk: Chunk,
        view: View | NovelView,
        image: NDArray[np.uint8],
        *,
        shift_m: float,
        rendered: bool,
        depth: Float32 | None,
    ) -> LabelledImage:
        """Labels an image of any viewpoint.

        Args:
            chunk: of this log.
            view: pose and lens of the image.
            image: [H, W, 3] sRGB, of the lens's size.
            shift_m: metres to the left of the recorded path.
            rendered: whether a scene was rendered.
            depth: [H, W] metres along the camera's axis, 0 where nothing is; ``None``: unknown.

        Returns:
            The image with its boxes. A box that is not in the image has none, nor has one that holds the camera.

        Raises:
            InputError: the frame's sweep cannot be read.
        """
        world_SE3_camera = chunk.world_SE3_chunk @ view.chunk_SE3_camera
        ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
        timestamp_s = view.timestamp_s if isinstance(view, View) else self._find_time(chunk, view)
        return LabelledImage(
            log=chunk.log,
            camera=view.camera,
            frame=view.frame,
            timestamp_s=timestamp_s,
            shift_m=shift_m,
            rendered=rendered,
            world_SE3_camera=world_SE3_camera,
            world_SE3_ego=chunk.world_SE3_chunk @ shift_laterally(ego, ego, shift_m),
            lens=view.lens,
            image=image,
            boxes=self._label_boxes(view, world_SE3_camera, depth),
        )

    def _find_time(self, chunk: Chunk, view: NovelView) -> float:
        """When the camera took the image that the view was moved from."""
        recorded = (v.timestamp_s for v in chunk.views if (v.camera, v.frame) == (view.camera, view.frame))
        time_s = next(recorded, None)
        return self.log.camera_timestamp_s(view.camera, view.frame) if time_s is None else time_s

    def _label_boxes(
        self, view: View | NovelView, world_SE3_camera: Float64, depth: Float32 | None
    ) -> tuple[LabelledBox, ...]:
        found = self._boxes_of(view.frame)
        camera_SE3_world = invert_se3(world_SE3_camera)
        poses = camera_SE3_world @ found.world_SE3_box
        velocities = found.world_velocity_m_s @ camera_SE3_world[:3, :3].T
        corners = box_corners(poses, found.size_m)
        labelled = []
        for k in find_boxes_in_view(corners, view.lens):
            outline = outline_box(corners[k], view.lens)
            if outline is None or _holds_camera(poses[k], found.size_m[k]):
                continue
            occluded = float("nan")
            if depth is not None:
                occluded = measure_occlusion(poses[k], found.size_m[k], view.lens, depth)
            track = found.tracks[k]
            labelled.append(
                LabelledBox(
                    track_id=track.track_id,
                    label=track.label,
                    size_m=track.size_m,
                    camera_SE3_box=poses[k].copy(),
                    box_px=outline.box_px,
                    truncated=outline.truncated,
                    occluded=occluded,
                    lidar_points=int(found.lidar_points[k]),
                    velocity_m_s=(float(velocities[k, 0]), float(velocities[k, 1]), float(velocities[k, 2])),
                )
            )
        return tuple(labelled)

    def _boxes_of(self, frame: int) -> _FrameBoxes:
        if frame not in self._frames:
            self._frames[frame] = self._collect_boxes(frame)
            if len(self._frames) > _CACHED_FRAMES:
                self._frames.popitem(last=False)
        return self._frames[frame]

    def _collect_boxes(self, frame: int) -> _FrameBoxes:
        rows = [
            (number, int(index[0]))
            for number, track in enumerate(self._tracks)
            if len(index := np.flatnonzero(track.frames == frame))
        ]
        tracks = tuple(self._tracks[number] for number, _ in rows)
        poses = np.array([self._tracks[number].world_SE3_box[k] for number, k in rows]).reshape(-1, 4, 4)
        sizes = np.array([track.size_m for track in tracks]).reshape(-1, 3)
        velocities = np.array([self._velocities[number][k] for number, k in rows]).reshape(-1, 3)
        sweep = self.log.sweep(frame)
        if sweep is None:
            counts = np.full(len(rows), NO_SWEEP_POINTS, np.int64)
        else:
            counts = count_points_in_boxes(sweep.points_world, poses, sizes)
        return _FrameBoxes(tracks, poses, sizes, velocities, counts)


_labellers: OrderedDict[int, LogLabeller] = OrderedDict()


def labeller_of(log: DrivingLog) -> LogLabeller:
    """Makes the labeller of a log once.

    Args:
        log: the same object gives the same labeller, as long as no two others were asked for since.

    Raises:
        InputError: the log has no annotations, or they cannot be read.
    """
    # By identity: logs need not be comparable. The labeller holds its log, so that the number is not used again.
    key = id(log)
    if key not in _labellers:
        _labellers[key] = LogLabeller(log)
        if len(_labellers) > _CACHED_LOGS:
            _labellers.popitem(last=False)
    return _labellers[key]


def count_points_in_boxes(points_world: Float64, world_SE3_box: Float64, size_m: Float64) -> NDArray[np.int64]:
    """Counts the points in each box, its surface included.

    Args:
        points_world: [N, 3].
        world_SE3_box: [B, 4, 4].
        size_m: [B, 3] length, width, height.

    Returns:
        [B].

    >>> points = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [1.1, 0.0, 0.0]])
    >>> count_points_in_boxes(points, np.eye(4)[None], np.array([[2.0, 2.0, 2.0]])).tolist()
    [2]
    """
    # Sorted by x, so that a box looks at a stripe and not at a whole sweep.
    points = points_world[np.argsort(points_world[:, 0])]
    radius = np.linalg.norm(size_m, axis=1) / 2
    first = np.searchsorted(points[:, 0], world_SE3_box[:, 0, 3] - radius, "left")
    last = np.searchsorted(points[:, 0], world_SE3_box[:, 0, 3] + radius, "right")
    counts = np.zeros(len(size_m), np.int64)
    for k, pose in enumerate(world_SE3_box):
        offset = points[first[k] : last[k]] - pose[:3, 3]
        offset = offset[np.abs(offset[:, 1]) <= radius[k]]
        local = (offset[:, :, None] * pose[:3, :3]).sum(1)
        counts[k] = (np.abs(local) <= size_m[k] / 2).all(1).sum()
    return counts


def _holds_camera(camera_SE3_box: Float64, size_m: Float64) -> bool:
    # A moved camera may stand in another car, whose outside no pixel shows.
    eye = (camera_SE3_box[:3, :3] * camera_SE3_box[:3, 3, None]).sum(0)
    return bool((np.abs(eye) < size_m / 2).all())


def _velocities(track: CuboidTrack, log: DrivingLog) -> Float64:
    """[F, 3] metres per second in the world, from the poses before and after."""
    count = len(track.frames)
    if count < 2:
        return np.zeros((count, 3))
    times = np.array([log.frame_timestamp_s(int(frame)) for frame in track.frames])
    before = np.maximum(np.arange(count) - 1, 0)
    after = np.minimum(np.arange(count) + 1, count - 1)
    centres = track.world_SE3_box[:, :3, 3]
    elapsed = times[after] - times[before]
    # A log may state one time for all of its frames.
    moved = (centres[after] - centres[before]) / np.where(elapsed > 0, elapsed, np.inf)[:, None]
    found: Float64 = moved
    return found
