"""What an evaluation found: metrics, scores of single views, and their pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Metric:
    """One number of an evaluation.

    Attributes:
        name: group and metric, as ``interpolation/psnr`` or ``shift_3m/kernel``.
        value: the number, in the metric's unit.
        n: number of images that it is of.
        low: lower end of a 95 % interval; ``None`` where none was made.
        high: upper end of it.
    """

    name: str
    value: float
    n: int
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class ViewScore:
    """How near one image is to its truth.

    Attributes:
        camera: name of the camera.
        frame: the log's frame.
        shift_m: distance to the left of the path, metres; 0 for held-out frames.
        psnr: dB.
        ssim: in [−1, 1].
        perceptual: the project's own perceptual distance, in [0, 4].
    """

    camera: str
    frame: int
    shift_m: float
    psnr: float
    ssim: float
    perceptual: float


@dataclass(frozen=True)
class Evaluation:
    """What ``evaluate/<stage>`` returns.

    Attributes:
        stage: the stage that was evaluated.
        metrics: all numbers.
        views: scores of single images, where there is a truth.
        curve: (iteration, held-out PSNR) along the unrolled iterations, where the stage kept snapshots.
        pictures: sRGB images [H, W, 3] uint8 by name, as ``0m_front_camera_04``, ``3m_left_front_camera_04`` or
            ``3m_right_…``. Every stage of a chunk has the same names; a truth has the suffix ``.truth``.
    """

    stage: str
    metrics: tuple[Metric, ...]
    views: tuple[ViewScore, ...] = ()
    curve: tuple[tuple[int, float], ...] = ()
    pictures: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
