"""What a detector finds in a chunk's recorded images and in renders of its scene, on the path and next to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.detections import Detections
from genre_tasks.detection.detector import Detector
from genre_tasks.errors import InputError
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.progress import Progress, silent
from genre_tasks.render import RenderSettings
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.stages.evaluation_renders import render_batches, split_into_batches
from storage.codecs.png import to_pixels

# A word of the table of detections.
ImageSource = Literal["recorded", "rendered"]


@dataclass(frozen=True)
class PerceivedImage:
    """An image with what a detector finds in it.

    Attributes:
        camera: of the rig.
        frame: log frame.
        shift_m: metres to the left of the recorded path; 0 on it.
        source: whether the camera recorded the image, or the scene was rendered.
        image: [H, W, 3] sRGB.
        detections: best score first.
    """

    camera: str
    frame: int
    shift_m: float
    source: ImageSource
    image: NDArray[np.uint8]
    detections: Detections


def select_views(chunk: Chunk, cameras: Sequence[str] | None, every: int) -> tuple[View, ...]:
    """Selects recorded views of a chunk.

    Args:
        chunk: whose views.
        cameras: names of cameras; ``None`` for all.
        every: every n-th frame.

    Returns:
        The views, in the chunk's order.

    Raises:
        InputError: the chunk has no such camera, or no image of the cameras at these frames.
    """
    unknown = [name for name in cameras or () if name not in chunk.camera_names]
    if unknown:
        raise InputError(
            f"the chunk has no camera '{unknown[0]}'",
            remedy=f"It has {', '.join(chunk.camera_names)}.",
            log=chunk.log,
            chunk=chunk.index,
        )
    # From the middle of an interval on, so that few frames stand for the chunk.
    frames = chunk.frames[every // 2 :: every] or chunk.frames[:1]
    chosen = [v for v in chunk.views if v.frame in frames and (cameras is None or v.camera in cameras)]
    if not chosen:
        raise InputError(
            "the cameras have no image at these frames", remedy="Lower --every.", log=chunk.log, chunk=chunk.index
        )
    return tuple(chosen)


def perceive_views(
    chunk: Chunk,
    scene: SceneGraph,
    views: Sequence[View],
    shifts_m: Sequence[float],
    detector: Detector,
    progress: Progress = silent,
) -> Iterator[PerceivedImage]:
    """Runs a detector on recorded images and on renders of the same views, moved by each shift.

    A render without a shift has the exposure and the shutter of its recorded image. Moved ones have none, since no
    camera was there.

    Args:
        chunk: with its plan's effects applied.
        scene: of the chunk.
        views: V recorded views of the chunk.
        shifts_m: metres to the left.
        detector: any.
        progress: called with the images done and their total.

    Yields:
        PerceivedImage: view by view in batches; of a batch the recorded images first, then the renders of each shift.

    Raises:
        InputError: a recorded image cannot be decoded.
    """
    # Poses of these frames alone, as finding the nearest recorded image of each view takes time.
    frames = sorted({view.frame for view in views})
    # Without a shift the recorded view itself, which knows exposure and shutter.
    moved: dict[float, dict[tuple[str, int], NovelView]] = {
        shift: {(v.camera, v.frame): v for v in place_novel_views(chunk, (shift,), frames)}
        for shift in shifts_m
        if shift
    }
    total = len(views) * (1 + len(shifts_m))
    done = 0
    # A view's recorded image and its renders come close to each other, so that callers can compare without keeping all.
    for batch in split_into_batches(views, chunk.width_px, chunk.height_px):
        for view in batch:
            image = to_pixels(decode_view_image(view))
            yield PerceivedImage(view.camera, view.frame, 0.0, "recorded", image, detector.detect(image))
        done += len(batch)
        progress(done, total, "recorded images")
        for shift in shifts_m:
            at_shift = [moved[shift][v.camera, v.frame] if shift else v for v in batch]
            for rendered, colors in render_batches(scene, at_shift, RenderSettings(), None):
                for view_there, image in zip(rendered, to_pixels(colors), strict=True):
                    found = detector.detect(image)
                    yield PerceivedImage(view_there.camera, view_there.frame, shift, "rendered", image, found)
            done += len(batch)
            progress(done, total, f"renders at {shift:+g} m")
