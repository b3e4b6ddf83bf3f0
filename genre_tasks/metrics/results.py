"""What an evaluation found: metrics, scores of single views, and their pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Metric:
    """One number of an evaluation: ``name`` as ``interpolation/psnr`` or ``shift_3m/kernel``; ``n`` images.

    ``low`` and ``high`` bound a 95 % interval where one was made.
    """

    name: str
    value: float
    n: int
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class ViewScore:
    """Scores of one image, where truth exists. ``shift_m`` is 0 for held-out frames."""

    camera: str
    frame: int
    shift_m: float
    psnr: float
    ssim: float
    perceptual: float


@dataclass(frozen=True)
class Evaluation:
    """What ``evaluate/<stage>`` returns.

    ``curve`` lists (iteration, held-out PSNR) along the unrolled iterations, where the stage kept snapshots.
    ``pictures`` maps a name like ``3m_left_front_camera_04`` (``0m_…``, ``3m_left_…``, ``3m_right_…``; the same names
    for every stage of a chunk, and ``…`` with the suffix ``.truth`` where truth exists) to an sRGB image [H, W, 3]
    uint8.
    """

    stage: str
    metrics: tuple[Metric, ...]
    views: tuple[ViewScore, ...] = ()
    curve: tuple[tuple[int, float], ...] = ()
    pictures: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
