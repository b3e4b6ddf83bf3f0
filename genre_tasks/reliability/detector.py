"""Which of the log's actors a detector finds in a render: what a stack in simulation would still see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.box_projection import AnyView, project_box
from genre_tasks.scene.chunk import Chunk

ROAD_USERS = (0, 1, 2, 3, 5, 7)
"""Of COCO's 80 classes: person, bicycle, car, motorcycle, bus, truck."""

COCO_CLASSES = 80

MIN_SCORE = 0.5
"""A detection counts from this score on."""

MIN_OVERLAP = 0.5
"""A detection finds an actor if their boxes in the image overlap at least so much (intersection over union)."""

MIN_HEIGHT_PX = 14
"""Actors whose box is lower in the image are not looked for."""


@dataclass(frozen=True)
class Detector:
    """A network of FastestDet's form (ONNX): [1, 3, S, S] BGR in [0, 1] → [1, 5 + 80, G, G] of COCO's classes.

    Each cell of the output holds objectness, a box, and a score for each class. The box is the offset of the centre
    before tanh, and width and height before the sigmoid.

    Attributes:
        session: onnxruntime's session of the network.
        size_px: side S of the square image that it takes.
    """

    session: Any
    size_px: int

    @staticmethod
    def load(path: Path) -> Detector:
        """Reads a detector.

        Args:
            path: an ONNX file.

        Raises:
            ConfigError: onnxruntime is not installed.
            InputError: the file is missing or holds no network of that form.
        """
        try:
            import onnxruntime
        except ImportError as error:
            raise ConfigError(
                "detectors run with onnxruntime, which is not installed",
                remedy="Run `pip install 'genre[perception]'`.",
            ) from error
        if not path.is_file():
            raise InputError("no such detector", remedy="Check --detector.", file=path)
        options = onnxruntime.SessionOptions()
        # onnxruntime would take all cores, whatever number torch was given.
        options.intra_op_num_threads = torch.get_num_threads()
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common class
            raise InputError(f"the detector cannot be read: {error}", remedy="Give an ONNX file.", file=path) from error
        inputs = [list(x.shape) for x in session.get_inputs()]
        outputs = [list(x.shape) for x in session.get_outputs()]
        # Another network's output would be read as boxes without an error.
        single = len(inputs) == 1 and len(outputs) == 1
        if not single or inputs[0][:2] != [1, 3] or outputs[0][:2] != [1, 5 + COCO_CLASSES]:
            raise InputError(
                f"the detector takes {inputs} and gives {outputs}",
                remedy="Give one of FastestDet's form: [1, 3, S, S] to [1, 85, G, G].",
                file=path,
            )
        return Detector(session, int(inputs[0][2]))

    def detect_boxes(self, image: Tensor) -> Float64:
        """Finds road users in an image.

        Args:
            image: [H, W, 3] sRGB in [0, 1].

        Returns:
            [N, 4] x and y of two opposite corners of each box, in pixels of ``image``.
        """
        size = (self.size_px, self.size_px)
        # Stretched to a square, as in training; boxes are fractions of the image and stretch back.
        scaled = interpolate(image.detach().float().permute(2, 0, 1)[None], size, mode="bilinear", antialias=True)
        # FastestDet was trained on images with blue first.
        bgr = scaled.flip(1).clamp(0, 1).numpy()
        (output,) = self.session.run(None, {self.session.get_inputs()[0].name: bgr})
        return _decode_output(output[0]) * np.array([image.shape[1], image.shape[0]] * 2, np.float64)

    def count_detected_actors(self, chunk: Chunk, view: AnyView, image: Tensor) -> tuple[int, int]:
        """Counts which of a chunk's actors the detector finds in an image.

        Args:
            chunk: the chunk with its actors.
            view: where the image is from.
            image: [H, W, 3] sRGB in [0, 1], at the size of the view's lens.

        Returns:
            How many actors are completely in the image and not too small, and how many of them are detected.
        """
        boxes = [project_box(actor, view) for actor in chunk.actors]
        expected = [np.concatenate([low, high]) for low, high in boxes if _is_detectable(low, high, view)]
        # Without actors to find the network need not run.
        if not expected:
            return 0, 0
        detections = self.detect_boxes(image)
        return len(expected), sum(_overlaps_any(box, detections) for box in expected)


def _decode_output(output: Float32) -> Float64:
    """[N, 4] boxes of road users as fractions of the image, from the network's output [85, G, G]."""
    cells = output[:5].astype(np.float64)
    classes = output[5:]
    best_class = classes.argmax(0)
    # FastestDet weighs objectness and class like this.
    score = cells[0].clip(0) ** 0.6 * classes.max(0).clip(0) ** 0.4
    row, column = np.nonzero((score >= MIN_SCORE) & np.isin(best_class, ROAD_USERS))
    _, dx, dy, width, height = cells[:, row, column]
    grid = np.array([output.shape[2], output.shape[1]])[:, None]
    centre = (np.stack([column, row]) + np.tanh([dx, dy])) / grid
    half_size = 0.5 / (1 + np.exp(-np.stack([width, height])))
    return np.concatenate([centre - half_size, centre + half_size]).T


def _is_detectable(low: NDArray[np.int64], high: NDArray[np.int64], view: AnyView) -> bool:
    """Whether a box is completely in the image and not too small; a cut box would not match a detection."""
    inside = low[0] > 0 and low[1] > 0 and high[0] < view.lens.width_px and high[1] < view.lens.height_px
    return bool(inside and high[1] - low[1] >= MIN_HEIGHT_PX)


def _overlaps_any(box: NDArray[np.int64], others: Float64) -> bool:
    """Whether one of the others has an intersection over union of at least ``MIN_OVERLAP``."""
    if not len(others):
        return False
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    common = sides.clip(0).prod(1)
    # In float64, since products of pixels can overflow smaller integers.
    area, other_areas = ((b[..., 2:] - b[..., :2]).prod(-1) for b in (box.astype(np.float64), others))
    return bool((common / (area + other_areas - common) >= MIN_OVERLAP).any())
