"""The detector's loss: a focal loss of the heatmaps, and absolute errors of what is predicted at the centres."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from genre_tasks.detection3d.network import Regressions
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.detection3d.targets import Targets

# Of the focal loss: how much sure answers count less, and cells next to a centre.
_SURENESS_POWER = 2
_NEARNESS_POWER = 4


def focal_loss(logits: Tensor, heat: Tensor) -> Tensor:
    """Compares heatmaps; cells that are right already count little, and those next to a centre too.

    Args:
        logits: [B, C, h, w] of the network.
        heat: [B, C, h, w] targets in [0, 1]; exactly 1 at centres.

    Returns:
        The sum over cells, over the number of centres or 1.
    """
    probability = torch.sigmoid(logits)
    is_centre = heat == 1
    # The logarithms of p and 1 − p, without rounding to −∞.
    at_centres = -functional.logsigmoid(logits) * (1 - probability) ** _SURENESS_POWER
    elsewhere = -functional.logsigmoid(-logits) * probability**_SURENESS_POWER * (1 - heat) ** _NEARNESS_POWER
    return torch.where(is_centre, at_centres, elsewhere).sum() / is_centre.sum().clamp(min=1)


def regression_loss(found: Regressions, wanted: Regressions, config: Detector3dConfig) -> Tensor:
    """Compares what is predicted at centres; the depth's error is weighed by what the network expects of it.

    Args:
        found: the network's.
        wanted: targets.
        config: weights of the terms.

    Returns:
        The mean over objects of the weighted sum; 0 without objects.
    """
    if not len(found.log_depths):
        # Still part of the graph, so that gradients exist.
        return found.log_depths.sum()
    # The likelihood of a Laplace distribution of that spread: a network that is unsure of a depth says so.
    depth = (found.log_depths - wanted.log_depths).abs() * torch.exp(-found.log_spreads) + found.log_spreads
    return (
        config.offset_weight * (found.offsets - wanted.offsets).abs().sum(1)
        + config.depth_weight * depth
        + config.size_weight * (found.log_sizes - wanted.log_sizes).abs().sum(1)
        + config.angle_weight * (found.angles - wanted.angles).abs().sum(1)
    ).mean()


def detection_loss(logits: Tensor, found: Regressions, targets: Targets, config: Detector3dConfig) -> Tensor:
    """Adds up the loss of a batch.

    Args:
        logits: [B, C, h, w] of the heatmaps.
        found: regressions at the cells of the targets.
        targets: what the network should answer.
        config: weights of the terms.

    Returns:
        The loss, which may be negative: a sure depth has a likelihood above 1.
    """
    return config.heat_weight * focal_loss(logits, targets.heat) + regression_loss(found, targets.regressions, config)
