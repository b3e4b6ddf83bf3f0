"""Images of a log, recorded or rendered, with the boxes that its annotation gives them.

Boxes stand where the annotation has them at the image's frame, interpolated between annotated frames, which is where a
scene is rendered with them. What a moving object moves between the sweep and the image is left out.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, DrivingLog, Float32, Float64
from genre_tasks.scene.actor_track import MOST_GAP_FRAMES, ValidAnnotations
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
"""What ``lidar_points`` is where the frame has no sweep that can be read."""

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
        self._annotations = [ValidAnnotations.from_track(track) for track in self._tracks]
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
            InputError: the image cannot be decoded.
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
        absent: frozenset[str] = frozenset(),
    ) -> LabelledImage:
        """Labels an image of any viewpoint.

        Args:
            chunk: of this log.
            view: pose and lens of the image.
            image: [H, W, 3] sRGB, of the lens's size.
            shift_m: metres to the left of the recorded path.
            rendered: whether a scene was rendered.
            depth: [H, W] metres along the camera's axis, 0 where nothing is; ``None``: unknown.
            absent: ids of objects that the image does not show, although the annotation has them.

        Returns:
            The image with its boxes. A box that is not in the image has none, nor has one that holds the camera.
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
            boxes=self._label_boxes(view, world_SE3_camera, depth, absent),
        )

    def _find_time(self, chunk: Chunk, view: NovelView) -> float:
        """When the camera took the image that the view was moved from."""
        recorded = (v.timestamp_s for v in chunk.views if (v.camera, v.frame) == (view.camera, view.frame))
        time_s = next(recorded, None)
        return self.log.camera_timestamp_s(view.camera, view.frame) if time_s is None else time_s

    def _label_boxes(
        self, view: View | NovelView, world_SE3_camera: Float64, depth: Float32 | None, absent: frozenset[str]
    ) -> tuple[LabelledBox, ...]:
        found = self._boxes_of(view.frame)
        camera_SE3_world = invert_se3(world_SE3_camera)
        poses = camera_SE3_world @ found.world_SE3_box
        velocities = found.world_velocity_m_s @ camera_SE3_world[:3, :3].T
        corners = box_corners(poses, found.size_m)
        labelled = []
        for k in find_boxes_in_view(corners, view.lens):
            outline = outline_box(corners[k], view.lens)
            track = found.tracks[k]
            if outline is None or track.track_id in absent or _holds_camera(poses[k], found.size_m[k]):
                continue
            occluded = float("nan")
            if depth is not None:
                occluded = measure_occlusion(poses[k], found.size_m[k], view.lens, depth)
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
        # Between annotations boxes stand where scenes have the object.
        found = [(k, annotations.find_pose(frame)) for k, annotations in enumerate(self._annotations)]
        rows = [(k, pose) for k, pose in found if pose is not None]
        tracks = tuple(self._tracks[k] for k, _ in rows)
        poses = np.array([pose for _, pose in rows]).reshape(-1, 4, 4)
        sizes = np.array([track.size_m for track in tracks]).reshape(-1, 3)
        velocities = np.array([self._measure_velocity(self._annotations[k], frame) for k, _ in rows]).reshape(-1, 3)
        return _FrameBoxes(tracks, poses, sizes, velocities, self._count_points(frame, poses, sizes))

    def _count_points(self, frame: int, world_SE3_box: Float64, size_m: Float64) -> NDArray[np.int64]:
        try:
            sweep = self.log.sweep(frame)
        except InputError:
            # Reconstruction went on without it, too.
            sweep = None
        if sweep is None:
            return np.full(len(size_m), NO_SWEEP_POINTS, np.int64)
        return count_points_in_boxes(sweep.points_world, world_SE3_box, size_m)

    def _measure_velocity(self, annotations: ValidAnnotations, frame: int) -> Float64:
        """[3] metres per second in the world, from the annotations around; 0 without two near ones, or their times."""
        last = len(annotations.frames) - 1
        before = max(int(np.searchsorted(annotations.frames, frame)) - 1, 0)
        after = min(int(np.searchsorted(annotations.frames, frame, "right")), last)
        # Poses are not interpolated over longer gaps either. The frame is annotated where a neighbour is so far.
        if frame - int(annotations.frames[before]) > MOST_GAP_FRAMES + 1:
            before += 1
        if int(annotations.frames[after]) - frame > MOST_GAP_FRAMES + 1:
            after -= 1
        try:
            times = [self.log.frame_timestamp_s(int(annotations.frames[k])) for k in (before, after)]
        except InputError:
            return np.zeros(3)
        elapsed = times[1] - times[0]
        moved: Float64 = annotations.world_SE3_box[after, :3, 3] - annotations.world_SE3_box[before, :3, 3]
        # A log may state one time for all of its frames.
        return moved / elapsed if elapsed > 0 else np.zeros(3)


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
