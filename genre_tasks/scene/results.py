"""What the reconstructing and the evaluating stages return."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class Reconstruction:
    """A scene and how it came about (output of ``initial``, ``gnet`` and ``enet``).

    ``losses`` [T] training loss per iteration; ``snapshots`` maps an iteration count to the scene after so many
    iterations (0 and T need not be in it); ``seconds_per_iteration`` is a measurement and no payload: it goes into the
    manifest. ``culled`` counts left-out Gaussians by reason in the last render.
    """

    scene: SceneGraph
    losses: tuple[float, ...] = ()
    snapshots: dict[int, SceneGraph] = field(default_factory=dict)
    seconds_per_iteration: tuple[float, ...] = ()
    culled: dict[str, int] = field(default_factory=dict)


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
