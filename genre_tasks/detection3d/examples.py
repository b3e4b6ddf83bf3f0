"""Labelled images as a detector is trained on them: of one size, and their boxes as the few numbers it predicts."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.errors import InputError
from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Lens
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage


@dataclass(frozen=True)
class Objects:
    """M objects in a batch or a set of images, each as its image shows it.

    Attributes:
        images: [M] index of the image; increasing.
        classes: [M] index of the class.
        centres_px: [M, 2] where the centre of the box appears.
        depths_m: [M] z of the centre in camera axes.
        angles: [M] observation angle: of the box's forward axis from the ray to its centre, about the camera's y axis.
        sizes_m: [M, 3] length, width, height.
    """

    images: Tensor
    classes: Tensor
    centres_px: Tensor
    depths_m: Tensor
    angles: Tensor
    sizes_m: Tensor

    def __len__(self) -> int:
        return len(self.images)

    def select(self, kept: Tensor) -> Objects:
        """Takes some of the objects.

        Args:
            kept: [M] true for those to keep, or their indices in the wanted order.
        """
        return Objects(
            self.images[kept],
            self.classes[kept],
            self.centres_px[kept],
            self.depths_m[kept],
            self.angles[kept],
            self.sizes_m[kept],
        )


@dataclass(frozen=True)
class TrainingExamples:
    """N images of one size with their objects.

    Attributes:
        images: [N, 3, H, W] uint8 sRGB.
        lenses: [N, 4] fx, fy, cx, cy at that size, pixels.
        objects: of all images; those whose centre is outside of the image are left out.
    """

    images: Tensor
    lenses: Tensor
    objects: Objects

    def __len__(self) -> int:
        return len(self.images)

    def digest(self) -> str:
        """Identifies the examples.

        Returns:
            A SHA-256.
        """
        state = hashlib.sha256()
        for values in (self.images, self.lenses, *vars(self.objects).values()):
            state.update(f"{tuple(values.shape)}".encode())
            state.update(values.contiguous().numpy().tobytes())
        return state.hexdigest()


def build_examples(images: Sequence[LabelledImage], config: Detector3dConfig) -> TrainingExamples:
    """Prepares labelled images for training.

    Args:
        images: of any sizes and lenses.
        config: size, classes, and which boxes count.

    Returns:
        The examples, in order.

    Raises:
        InputError: there are no images, none of them has a box that counts, or a box is not finite.
    """
    if not images:
        raise InputError("there are no training images", remedy="Choose logs with images.", stage="train detector")
    pixels = torch.empty(len(images), 3, config.height_px, config.width_px, dtype=torch.uint8)
    lenses = torch.empty(len(images), 4)
    found = []
    for n, image in enumerate(images):
        lens = fit_lens(image.lens, config)
        pixels[n] = resize_image(image.image, lens, config)
        lenses[n] = torch.tensor([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px])
        found.append(_describe_objects(n, select_boxes(image, config), lens))
    objects = Objects(*(torch.cat([getattr(part, name) for part in found]) for name in Objects.__dataclass_fields__))
    if not len(objects):
        names = ", ".join(kind.name for kind in config.classes)
        raise InputError(
            f"no training image has a box of {names} that counts",
            remedy="Choose logs with boxes, add their labels to the classes, or set min_lidar_points to 0.",
            log=images[0].log,
            stage="train detector",
        )
    return TrainingExamples(pixels, lenses, objects)


def select_boxes(image: LabelledImage, config: Detector3dConfig) -> tuple[tuple[int, LabelledBox], ...]:
    """Chooses the boxes that count, in training and in evaluation alike.

    As nuScenes does, boxes without LiDAR points are left out: nobody can see those objects. So are boxes of other
    classes, those far away, and those whose centre is outside of the image, which a detector of centres cannot find.

    Args:
        image: with its boxes.
        config: which of them count.

    Returns:
        Index of the class and box of each.

    Raises:
        InputError: a box is not finite.
    """
    chosen = []
    for box in image.boxes:
        kind = config.class_of(box.label)
        if kind is None:
            continue
        _require_sound(box, image)
        centre = box.camera_SE3_box[:3, 3]
        # Compared as a negation: where nothing says how much is hidden, it is NaN, and the box counts.
        counts = not box.occluded > config.max_occluded
        # -1 points: the frame has no sweep that could tell.
        counts &= box.lidar_points < 0 or box.lidar_points >= config.min_lidar_points
        counts &= bool(centre[2] > 0) and float(np.hypot(centre[0], centre[2])) < config.max_range_m
        if counts and _is_inside(project_centre(centre, image.lens), image.lens):
            chosen.append((kind, box))
    return tuple(chosen)


def fit_lens(lens: Lens, config: Detector3dConfig) -> Lens:
    """Scales a lens to the detector's images, its sides in proportion.

    Args:
        lens: of the image.
        config: the size that images are brought to.

    Returns:
        The lens of the scaled image, which may be smaller than the detector's in one direction.
    """
    scale = min(config.width_px / lens.width_px, config.height_px / lens.height_px)
    return lens.resized(max(1, round(lens.width_px * scale)), max(1, round(lens.height_px * scale)))


def resize_image(image: NDArray[np.uint8], lens: Lens, config: Detector3dConfig) -> Tensor:
    """Brings an image to the detector's size; what it does not cover, to the right or below, is black.

    Args:
        image: [H, W, 3] sRGB.
        lens: of the scaled image, see :func:`fit_lens`.
        config: the detector's size.

    Returns:
        [3, H, W] uint8.
    """
    # A copy, since torch warns about arrays that may not be written, such as decoded images.
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)
    size = (lens.height_px, lens.width_px)
    if tuple(pixels.shape[1:]) != size:
        # Averaged over the area of a pixel: fine texture would else turn into noise.
        scaled = functional.interpolate(pixels[None].float(), size, mode="bilinear", antialias=True)[0]
        pixels = scaled.round().clamp(0, 255).to(torch.uint8)
    return functional.pad(pixels, (0, config.width_px - size[1], 0, config.height_px - size[0]))


def project_centre(centre: NDArray[np.float64], lens: Lens) -> tuple[float, float]:
    """Finds where a point appears.

    Args:
        centre: [3] in camera axes, z > 0.
        lens: of the camera.

    Returns:
        x and y, pixels.

    >>> project_centre(np.array([1.0, 0.5, 10.0]), Lens(100.0, 100.0, 32.0, 16.0, 64, 32))
    (42.0, 21.0)
    """
    x, y = distort(centre[:1] / centre[2], centre[1:2] / centre[2], lens.coefficients)
    return float(lens.fx_px * x[0] + lens.cx_px), float(lens.fy_px * y[0] + lens.cy_px)


def observation_angle(camera_SE3_box: NDArray[np.float64]) -> float:
    """Measures how a box is turned to the camera's ray; the image shows this angle, and not the heading.

    Args:
        camera_SE3_box: [4, 4] pose in camera axes.

    Returns:
        Angle of the box's forward axis from the ray to its centre, about the camera's y axis, in [−π, π].

    >>> pose = np.eye(4)
    >>> pose[:3, 3] = (0.0, 0.0, 10.0)
    >>> pose[:3, 0] = (1.0, 0.0, 0.0)
    >>> round(observation_angle(pose), 4)
    1.5708
    """
    heading = np.arctan2(camera_SE3_box[0, 0], camera_SE3_box[2, 0])
    ray = np.arctan2(camera_SE3_box[0, 3], camera_SE3_box[2, 3])
    return float((heading - ray + np.pi) % (2 * np.pi) - np.pi)


def _describe_objects(image: int, boxes: Sequence[tuple[int, LabelledBox]], lens: Lens) -> Objects:
    centres = [project_centre(box.camera_SE3_box[:3, 3], lens) for _, box in boxes]
    return Objects(
        images=torch.full((len(boxes),), image),
        classes=torch.tensor([kind for kind, _ in boxes], dtype=torch.long),
        centres_px=torch.tensor(centres, dtype=torch.float32).reshape(-1, 2),
        depths_m=torch.tensor([float(box.camera_SE3_box[2, 3]) for _, box in boxes]),
        angles=torch.tensor([observation_angle(box.camera_SE3_box) for _, box in boxes]),
        sizes_m=torch.tensor([box.size_m for _, box in boxes], dtype=torch.float32).reshape(-1, 3),
    )


def _is_inside(centre_px: tuple[float, float], lens: Lens) -> bool:
    return 0 <= centre_px[0] < lens.width_px and 0 <= centre_px[1] < lens.height_px


def _require_sound(box: LabelledBox, image: LabelledImage) -> None:
    if np.isfinite(box.camera_SE3_box).all() and all(0 < side < np.inf for side in box.size_m):
        return
    raise InputError(
        f"the box of {box.track_id} is not finite, or its size not positive",
        remedy="Correct the annotation, or leave the frame out.",
        log=image.log,
        camera=image.camera,
        frame=image.frame,
    )
