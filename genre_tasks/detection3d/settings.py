"""Settings of the detector, of its training and of its evaluation."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from genre_tasks.config.section import LearningRate, LossWeight, Section, Seed, Text, TextList
from genre_tasks.detection3d.average_precision import THRESHOLDS_M

Size = Annotated[tuple[float, float, float], Field(strict=False)]
MOST_STEPS = 1_000_000
Metres = Annotated[float, Field(gt=0, le=1000)]


class DetectedClass(Section):
    """A class of objects.

    >>> DetectedClass(name="car", labels=("Car",), size_m=(4.5, 1.9, 1.6)).name
    'car'
    """

    name: Text = Field(description="What results call it.")
    labels: TextList = Field(description="Labels of logs that mean it, in any case of letters.")
    size_m: Size = Field(description="Usual length, width, height; predicted sizes are relative to it.")

    @model_validator(mode="after")
    def _require_size(self) -> Self:
        # Its logarithm is taken.
        if not all(0 < side <= 100 for side in self.size_m):
            raise ValueError("size_m is not positive")
        return self


CAR = DetectedClass(
    name="car",
    labels=("Car", "Vehicle", "vehicle.car", "REGULAR_VEHICLE", "Van"),
    size_m=(4.5, 1.9, 1.6),
)
PEDESTRIAN = DetectedClass(
    name="pedestrian",
    labels=(
        "Pedestrian",
        "Pedestrian with Object",
        "Person",
        "human.pedestrian.adult",
        "human.pedestrian.child",
        "human.pedestrian.construction_worker",
        "human.pedestrian.police_officer",
    ),
    size_m=(0.8, 0.8, 1.75),
)


class Detector3dConfig(Section):
    """A detector and its training: what it finds, in which images, and how long it learns.

    The number of gradient steps is fixed, whatever the number of training images.

    >>> Detector3dConfig().steps
    3000
    """

    classes: Annotated[tuple[DetectedClass, ...], Field(strict=False, min_length=1, max_length=20)] = Field(
        (CAR, PEDESTRIAN), description="What it finds; boxes with other labels are ignored."
    )
    width_px: int = Field(320, ge=32, le=2048, description="Width that images are brought to.")
    height_px: int = Field(180, ge=32, le=2048, description="Height that images are brought to.")
    width: int = Field(
        32, ge=16, le=256, multiple_of=16, description="Channels of the feature map at a quarter of the resolution."
    )
    steps: int = Field(3000, ge=1, le=MOST_STEPS, description="Gradient steps.")
    batch: int = Field(8, ge=1, le=256, description="Images per step.")
    learning_rate: LearningRate = Field(2e-3, description="Of AdamW, at its largest.")
    warm_up: int = Field(100, ge=1, description="Steps over which the learning rate rises.")
    weight_decay: float = Field(0.01, ge=0, le=1, description="Of AdamW.")
    clip: float = Field(10.0, gt=0, description="Largest norm of the gradient.")
    flip: float = Field(0.5, ge=0, le=1, description="Share of training images that are mirrored.")
    zoom: float = Field(0.25, ge=0, le=0.9, description="Focal lengths change by up to this share, depths do not.")
    shift: float = Field(0.1, ge=0, le=0.5, description="Images move by up to this share of their size.")
    colour_jitter: float = Field(0.25, ge=0, le=0.9, description="Largest change of brightness, contrast and gains.")
    heat_weight: LossWeight = Field(1.0, description="Weight of the heatmap's loss.")
    offset_weight: LossWeight = Field(1.0, description="Weight of the centre's loss.")
    depth_weight: LossWeight = Field(1.0, description="Weight of the depth's loss.")
    size_weight: LossWeight = Field(1.0, description="Weight of the size's loss.")
    angle_weight: LossWeight = Field(0.5, description="Weight of the observation angle's loss.")
    min_lidar_points: int = Field(1, ge=0, description="Boxes with fewer points do not count; those of no sweep do.")
    max_occluded: float = Field(0.7, ge=0, le=1, description="Boxes of which more is hidden do not count.")
    max_range_m: Metres = Field(40.0, description="Boxes and detections farther away on the ground do not count.")
    thresholds_m: Annotated[tuple[Metres, ...], Field(strict=False, min_length=1)] = Field(
        THRESHOLDS_M, description="Distances within which a detection matches a box."
    )
    max_detections: int = Field(50, ge=1, le=1000, description="Detections of an image.")
    checkpoint_every: int = Field(100, ge=1, description="Steps between checkpoints.")
    seed: Seed = Field(0, description="Of weights, of the order of images and of their changes.")

    @model_validator(mode="after")
    def _require_distinct_classes(self) -> Self:
        names = [kind.name for kind in self.classes]
        labels = [label.lower() for kind in self.classes for label in kind.labels]
        # A label of two classes would train both, and each would be wrong half of the time.
        if len(set(names)) < len(names) or len(set(labels)) < len(labels):
            raise ValueError("two classes share a name or a label")
        return self

    def class_of(self, label: str) -> int | None:
        """Finds the class that a label means.

        Args:
            label: in a log's words.

        Returns:
            Index of the class; ``None`` for labels of none.

        >>> Detector3dConfig().class_of("PEDESTRIAN"), Detector3dConfig().class_of("Bus")
        (1, None)
        """
        for index, kind in enumerate(self.classes):
            if label.lower() in (known.lower() for known in kind.labels):
                return index
        return None
