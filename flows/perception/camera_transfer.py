"""Cross-camera agreement (paper Table 7): a scene of one camera, rendered as another camera of the rig recorded it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.agreement import Agreement, ImageMatches, match_image, summarise_matches
from genre_tasks.detection.coco_classes import find_road_users
from genre_tasks.errors import InputError
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.transforms import invert_se3
from storage.codecs.png import to_pixels

if TYPE_CHECKING:
    from genre_tasks.detection.detections import Detections
    from genre_tasks.detection.detector import Detector
    from genre_tasks.logs.types import DrivingLog
    from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class ImagePairs:
    """What a camera recorded, and what a scene shows from there.

    Attributes:
        views: V views of the camera.
        recorded: [V, H, W, 3] sRGB.
        rendered: [V, H, W, 3] sRGB.
    """

    views: tuple[View, ...]
    recorded: NDArray[np.uint8]
    rendered: NDArray[np.uint8]


@dataclass(frozen=True)
class DetectionPairs:
    """What a detector finds in pairs of images.

    Attributes:
        recorded: finds in each recorded image.
        rendered: finds in each rendered one.
        classes: the detector's classes of road users, which count.
    """

    recorded: tuple[Detections, ...]
    rendered: tuple[Detections, ...]
    classes: tuple[int, ...]

    def match(self, *, of_masks: bool = False) -> list[ImageMatches]:
        """Matches road users, image by image.

        Args:
            of_masks: whether masks overlap, and not boxes.
        """
        pairs = zip(self.recorded, self.rendered, strict=True)
        return [match_image(real, simulated, self.classes, of_masks=of_masks) for real, simulated in pairs]


def list_camera_views(log: DrivingLog, chunk: Chunk, camera: str) -> tuple[View, ...]:
    """Lists the views of a camera that a chunk was made without.

    Args:
        log: of the chunk.
        chunk: whose frames and working resolution.
        camera: name of any camera of the log.

    Returns:
        The views of frames that have an image, held out.

    Raises:
        InputError: the camera has no image in the chunk, or an image or pose cannot be read.
    """
    chunk_SE3_world = invert_se3(chunk.world_SE3_chunk)
    # At the working resolution, which renders have, too.
    lens = next(c.lens for c in log.cameras if c.name == camera).resized(chunk.width_px, chunk.height_px)
    views = []
    for frame in chunk.frames:
        image = log.image_bytes(camera, frame)
        # A log may lack an image now and then; the others still compare.
        if image is not None:
            time_s = log.camera_timestamp_s(camera, frame)
            pose = chunk_SE3_world @ log.world_SE3_camera(camera, frame)
            views.append(View(camera, frame, "heldout", time_s, pose, lens, image))
    if not views:
        raise InputError(
            "the camera has no image in the chunk", remedy="Choose other --chunks.", log=log.name, camera=camera
        )
    return tuple(views)


def render_camera(log: DrivingLog, chunk: Chunk, scene: SceneGraph, camera: str) -> ImagePairs:
    """Renders a scene as a camera recorded it.

    Args:
        log: of the chunk.
        chunk: that the scene is of.
        scene: to render.
        camera: name of any camera of the log.

    Returns:
        Recorded and rendered images.

    Raises:
        InputError: an image cannot be read.
    """
    # Imported here: what only predicts or prints a table should not load the renderer.
    from genre_tasks.render import RenderSettings
    from genre_tasks.stages.evaluation_renders import render_batches

    views = list_camera_views(log, chunk, camera)
    # Recorded images are as coarse as renders, so that size alone makes no difference.
    recorded = [to_pixels(decode_image(v.image, v.lens.width_px, v.lens.height_px)[None])[0] for v in views]
    rendered = [to_pixels(images) for _, images in render_batches(scene, views, RenderSettings(), None)]
    return ImagePairs(views, np.stack(recorded), np.concatenate(rendered))


def detect_pairs(detector: Detector, images: ImagePairs) -> DetectionPairs:
    """Runs a detector on recorded and rendered images.

    Args:
        detector: any.
        images: of one camera.
    """
    recorded = tuple(detector.detect(image) for image in images.recorded)
    rendered = tuple(detector.detect(image) for image in images.rendered)
    return DetectionPairs(recorded, rendered, find_road_users(detector.class_names))


def agreement_metrics(pairs: Sequence[DetectionPairs], *, has_masks: bool) -> dict[str, float]:
    """Names the agreement's numbers as metrics.

    Args:
        pairs: finds of one detector.
        has_masks: whether the finds have masks.

    Returns:
        ``box/ap``, ``box/recall``, ``box/iou`` (instances that were found), ``box/iou_all`` (all, 0 for one that was
        not found) and ``box/instances``; ``mask/…`` likewise where there are masks.
    """
    metrics: dict[str, float] = {}
    # Instances are pooled over images first: an image may have none.
    for kind in ("box", "mask") if has_masks else ("box",):
        matches = [image for pair in pairs for image in pair.match(of_masks=kind == "mask")]
        metrics |= {f"{kind}/{name}": value for name, value in _name_numbers(summarise_matches(matches)).items()}
    return metrics


def _name_numbers(agreement: Agreement) -> dict[str, float]:
    return {
        "ap": agreement.average_precision,
        "recall": agreement.recall,
        "iou": agreement.matched_overlap,
        "iou_all": agreement.mean_overlap,
        "instances": float(agreement.instances),
    }
