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
from genre_tasks.scene.box_projection import Seeing, outline
from genre_tasks.scene.chunk import Chunk

ROAD_USERS = (0, 1, 2, 3, 5, 7)
"""Of COCO's 80 classes: person, bicycle, car, motorcycle, bus, truck."""
COCO = 80
SCORE, OVERLAP = 0.5, 0.5
"""A detection counts from this score on, and finds an actor whose box in the image it overlaps so much (IoU)."""
LEAST_PX = 14
"""Actors whose box is lower in the image are not looked for."""


@dataclass(frozen=True)
class Detector:
    """A network of FastestDet's form (ONNX): [1, 3, S, S] BGR in [0, 1] → [1, 5 + 80, G, G] of COCO's classes.

    Of each cell: objectness, box (offset of the centre before tanh, width and height before the sigmoid), classes.
    """

    session: Any
    size_px: int

    @staticmethod
    def load(path: Path) -> Detector:
        """Raises ``ConfigError`` without onnxruntime, ``InputError`` for a file that is no network of that form."""
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
        options.intra_op_num_threads = torch.get_num_threads()
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common class
            raise InputError(f"the detector cannot be read: {error}", remedy="Give an ONNX file.", file=path) from error
        given, made = ([list(x.shape) for x in found] for found in (session.get_inputs(), session.get_outputs()))
        if len(given) != 1 or len(made) != 1 or given[0][:2] != [1, 3] or made[0][:2] != [1, 5 + COCO]:
            raise InputError(
                f"the detector takes {given} and gives {made}",
                remedy="Give one of FastestDet's form: [1, 3, S, S] to [1, 85, G, G].",
                file=path,
            )
        return Detector(session, int(given[0][2]))

    def boxes(self, image: Tensor) -> Float64:
        """[N, 4] x and y of two corners in pixels of ``image`` [H, W, 3] sRGB in [0, 1], of road users alone."""
        size = (self.size_px, self.size_px)
        scaled = interpolate(image.detach().float().permute(2, 0, 1)[None], size, mode="bilinear", antialias=True)
        (out,) = self.session.run(None, {self.session.get_inputs()[0].name: scaled.flip(1).clamp(0, 1).numpy()})
        return _decoded(out[0]) * np.array([image.shape[1], image.shape[0]] * 2, np.float64)

    def found(self, chunk: Chunk, view: Seeing, image: Tensor) -> tuple[int, int]:
        """How many of the chunk's actors are wholly in the view's image and not too small, and how many are detected.

        ``image`` [H, W, 3] sRGB in [0, 1], at the size of the view's lens.
        """
        looked = [(low, high) for low, high in (outline(a, view) for a in chunk.actors) if _whole(low, high, view)]
        if not looked:
            return 0, 0
        boxes = self.boxes(image)
        return len(looked), sum(_overlaps(np.concatenate(pair), boxes) for pair in looked)


def _decoded(out: Float32) -> Float64:
    """[N, 4] of [85, G, G], as shares of the image."""
    cells, classes = out[:5].astype(np.float64), out[5:]
    best = classes.argmax(0)
    score = cells[0].clip(0) ** 0.6 * classes.max(0).clip(0) ** 0.4
    row, column = np.nonzero((score >= SCORE) & np.isin(best, ROAD_USERS))
    _, dx, dy, width, height = cells[:, row, column]
    centre = (np.stack([column, row]) + np.tanh([dx, dy])) / np.array([out.shape[2], out.shape[1]])[:, None]
    half = 0.5 / (1 + np.exp(-np.stack([width, height])))
    return np.concatenate([centre - half, centre + half]).T


def _whole(low: NDArray[np.int64], high: NDArray[np.int64], view: Seeing) -> bool:
    inside = low[0] > 0 and low[1] > 0 and high[0] < view.lens.width_px and high[1] < view.lens.height_px
    return bool(inside and high[1] - low[1] >= LEAST_PX)


def _overlaps(box: NDArray[np.int64], others: Float64) -> bool:
    """Whether one of the others has an IoU of at least ``OVERLAP``."""
    if not len(others):
        return False
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    common = sides.clip(0).prod(1)
    areas = [(b[..., 2:] - b[..., :2]).prod(-1) for b in (box.astype(np.float64), others)]
    return bool((common / (areas[0] + areas[1] - common) >= OVERLAP).any())
