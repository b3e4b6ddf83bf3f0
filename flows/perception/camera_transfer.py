"""Cross-camera agreement (paper Table 7): a scene of one camera, rendered as another camera of the rig recorded it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.detection.agreement import Agreement, ImageMatches, match_image, summarise_matches
from genre_tasks.detection.coco_classes import find_road_users
from genre_tasks.errors import InputError
from genre_tasks.logs.log_selection import choose_working_size
from genre_tasks.logs.types import Camera
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.transforms import invert_se3
from storage.codecs.png import to_pixels

if TYPE_CHECKING:
    from genre_tasks.detection.detections import Detections
    from genre_tasks.detection.detector import Detector
    from genre_tasks.logs.types import DrivingLog, Lens
    from genre_tasks.scene.graph import SceneGraph

# As in log_selection: sizes that differ by less are of one shape.
_MAX_SHAPE_ERROR = 0.02


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


def choose_image_size(lens: Lens, chunk: Chunk) -> tuple[int, int]:
    """Chooses the size at which a camera is compared that a chunk was made without.

    Args:
        lens: of the camera, at the native resolution.
        chunk: whose working resolution is meant.

    Returns:
        Width and height in pixels: the chunk's where the camera has its shape. Another camera has about as many pixels
        in its own shape, since squeezed road users are not what detectors know.
    """
    shape = lens.width_px / lens.height_px
    chunk_shape = chunk.width_px / chunk.height_px
    # The chunk's sides are rounded to even numbers, which small images show.
    rounding = 1 / chunk.width_px + 1 / chunk.height_px
    if abs(shape / chunk_shape - 1) < _MAX_SHAPE_ERROR + rounding:
        return chunk.width_px, chunk.height_px
    config = IngestConfig().model_copy(update={"width_px": chunk.width_px, "height_px": chunk.height_px})
    return choose_working_size(config, [Camera("", lens)])


def list_camera_views(log: DrivingLog, chunk: Chunk, camera: str) -> tuple[View, ...]:
    """Lists the views of a camera that a chunk was made without.

    Args:
        log: of the chunk.
        chunk: whose frames; its working resolution, in the camera's own shape.
        camera: name of any camera of the log.

    Returns:
        The views of frames that have an image, held out.

    Raises:
        InputError: the camera has no image in the chunk, or an image or pose cannot be read.
    """
    chunk_SE3_world = invert_se3(chunk.world_SE3_chunk)
    # At the working resolution, which renders have, too.
    lens = next(c.lens for c in log.cameras if c.name == camera)
    lens = lens.resized(*choose_image_size(lens, chunk))
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
