"""What the network should answer for a batch: heatmaps with a bump at each centre, and numbers at its cell."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.detection3d.augmentation import Batch
from genre_tasks.detection3d.network import PADDING, STRIDE, Regressions
from genre_tasks.detection3d.settings import Detector3dConfig

# A bump's standard deviation over the object's size in the image; about half of the object is within two of them.
_BUMP_SHARE = 0.12
_MIN_BUMP_CELLS = 0.7
_MAX_BUMP_CELLS = 3.0


@dataclass(frozen=True)
class Targets:
    """What the network should answer for a batch.

    Attributes:
        heat: [B, C, h, w] in [0, 1]; 1 at the cells of centres.
        images: [M] index of the image of each object.
        cells: [M, 2] column and row of each.
        regressions: at these cells; spreads are not defined, and zero.
    """

    heat: Tensor
    images: Tensor
    cells: Tensor
    regressions: Regressions


def build_targets(batch: Batch, config: Detector3dConfig) -> Targets:
    """Builds the targets of a batch.

    Args:
        batch: with the objects whose centres are inside of the images.
        config: classes with their usual sizes.

    Returns:
        The targets.
    """
    height, width = (-(-side // PADDING) * PADDING // STRIDE for side in batch.images.shape[-2:])
    objects = batch.objects
    positions = objects.centres_px / STRIDE
    cells = positions.long()
    # One focal length: pixels are square but for rounding.
    focal_px = batch.lenses[objects.images, :2].mean(1)
    usual = torch.tensor([kind.size_m for kind in config.classes])[objects.classes]
    regressions = Regressions(
        offsets=positions - (cells + 0.5),
        log_depths=torch.log(objects.depths_m / focal_px),
        log_spreads=torch.zeros(len(objects)),
        log_sizes=torch.log(objects.sizes_m / usual),
        angles=torch.stack([torch.sin(objects.angles), torch.cos(objects.angles)], 1),
    )
    # Of the side that looks smaller: bumps of neighbours must not merge.
    extent_px = focal_px * objects.sizes_m.amin(1) / objects.depths_m
    bumps = (_BUMP_SHARE * extent_px / STRIDE).clamp(_MIN_BUMP_CELLS, _MAX_BUMP_CELLS)
    heat = torch.zeros(len(batch.images), len(config.classes), height, width)
    rows = torch.arange(height)[:, None]
    columns = torch.arange(width)[None]
    for n in range(len(objects)):
        squared = (columns - cells[n, 0]) ** 2 + (rows - cells[n, 1]) ** 2
        bump = torch.exp(-squared / (2 * bumps[n] ** 2))
        place = heat[objects.images[n], objects.classes[n]]
        # The larger of overlapping bumps, so that each centre stays a peak.
        torch.maximum(place, bump, out=place)
    return Targets(heat, objects.images, cells, regressions)
