"""Boxes in space from what the network answers: peaks of the heatmaps, put at their depths along their rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from genre_tasks.detection3d.examples import fit_lens
from genre_tasks.detection3d.network import STRIDE, Regressions
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.lens_distortion import pixels_to_rays

# A box counts as found within about this distance, the middle one of the metric's thresholds.
_TOLERANCE_M = 2.0


@dataclass(frozen=True)
class Detections3d:
    """N boxes that were found in one image, best score first.

    Attributes:
        camera_SE3_box: [N, 4, 4] camera axes x right, y down, z forward; box axes x forward, y left, z up; the origin
            is the box's centre. Boxes stand upright in the camera's axes.
        sizes_m: [N, 3] length, width, height.
        scores: [N] in [0, 1].
        classes: [N] index of the class.
    """

    camera_SE3_box: Float64
    sizes_m: Float64
    scores: Float64
    classes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True)
class Peaks:
    """Peaks of the heatmaps of one image, highest first.

    Attributes:
        heights: [K] in [0, 1].
        classes: [K] index of the class.
        cells: [K, 2] column and row.
    """

    heights: Tensor
    classes: Tensor
    cells: Tensor


def find_peaks(heat: Tensor, count: int) -> Peaks:
    """Finds the highest cells that are not lower than their eight neighbours.

    Args:
        heat: [C, h, w] in [0, 1].
        count: largest number of peaks, over all classes.

    Returns:
        The peaks.
    """
    highest = functional.max_pool2d(heat[None], 3, 1, 1)[0]
    peaks = torch.where(heat == highest, heat, torch.zeros_like(heat))
    width = heat.shape[2]
    cells = heat.shape[1] * width
    heights, places = torch.topk(peaks.flatten(), min(count, peaks.numel()))
    # Where there are fewer peaks than asked for, the rest is no peak at all.
    places = places[heights > 0]
    within = places % cells
    return Peaks(heights[: len(places)], places // cells, torch.stack([within % width, within // width], 1))


def decode_boxes(peaks: Peaks, found: Regressions, lens: Lens, config: Detector3dConfig) -> Detections3d:
    """Puts boxes into space.

    The score is the height of the peak times the probability that the depth is right to about 2 m, as far as the
    network knows it.

    Args:
        peaks: of the heatmaps.
        found: [K] regressions at the peaks.
        lens: of the image as it was given, before it was brought to the detector's size.
        config: the detector's size and classes.

    Returns:
        The boxes, best score first.
    """
    fitted = fit_lens(lens, config)
    focal_px = (fitted.fx_px + fitted.fy_px) / 2
    pixels = (peaks.cells + 0.5 + found.offsets).double().numpy() * STRIDE
    x_rays, y_rays = pixels_to_rays(pixels[:, 0], pixels[:, 1], fitted)
    depths = np.exp(found.log_depths.double().numpy()) * focal_px
    usual = np.array([kind.size_m for kind in config.classes])[peaks.classes.numpy()]
    angles = found.angles.double().numpy()
    headings = np.arctan2(angles[:, 0], angles[:, 1]) + np.arctan2(x_rays, 1.0)
    boxes = np.tile(np.eye(4), (len(depths), 1, 1))
    boxes[:, 0, 0] = np.sin(headings)
    boxes[:, 2, 0] = np.cos(headings)
    # Left is up × forward, and up is −y.
    boxes[:, :3, 2] = (0.0, -1.0, 0.0)
    boxes[:, :3, 1] = np.cross(boxes[:, :3, 2], boxes[:, :3, 0])
    boxes[:, :3, 3] = np.stack([x_rays, y_rays, np.ones_like(depths)], 1) * depths[:, None]
    spreads_m = np.exp(found.log_spreads.double().numpy()) * depths
    scores = peaks.heights.double().numpy() * -np.expm1(-_TOLERANCE_M / spreads_m)
    order = np.argsort(-scores, kind="stable")
    sizes = usual * np.exp(found.log_sizes.double().numpy())
    return Detections3d(boxes[order], sizes[order], scores[order], peaks.classes.numpy()[order])
