"""The detector's network: a small pyramid with one head for where objects are and one for what they are like.

It finds the centres of objects as peaks of a heatmap at a quarter of the resolution, and reads off everything else at
a peak. Two more input channels hold each pixel's place relative to the principal point: on a level road the row of an
object's foot gives its depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDE = 4
"""Pixels of the image per cell of the output."""

PADDING = 32
"""Heights and widths are padded to multiples of this, the coarsest level's stride."""

LOG_DEPTH = -2.5
"""Usual logarithm of depth over focal length, metres per pixel, to which the network's output is added."""

# Offset of the centre, depth and its spread, sizes, sine and cosine of the observation angle.
_REGRESSIONS = 2 + 2 + 3 + 2
# A first guess of 0.1 everywhere would drown what little there is of objects; so says the focal loss's paper.
_FIRST_HEAT = 0.02
_COORDINATE_PX = 100.0
_GROUP_CHANNELS = 8


@dataclass(frozen=True)
class Regressions:
    """What the network says of objects at N cells.

    Attributes:
        offsets: [N, 2] of the centre from the cell's middle, cells.
        log_depths: [N] logarithm of depth over focal length.
        log_spreads: [N] logarithm of the expected error of ``log_depths``.
        log_sizes: [N, 3] logarithm of length, width, height over the class's usual size.
        angles: [N, 2] sine and cosine of the observation angle, of any norm.
    """

    offsets: Tensor
    log_depths: Tensor
    log_spreads: Tensor
    log_sizes: Tensor
    angles: Tensor


class _Block(nn.Module):
    """Two convolutions with a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.first_norm = _norm(outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.second_norm = _norm(outputs)
        # Averaged and not skipped: a strided shortcut ignores three quarters of its input, and oneDNN's gradient of it
        # writes out of bounds at some numbers of channels.
        self.shortcut = nn.Sequential(nn.AvgPool2d(stride), nn.Conv2d(inputs, outputs, 1, bias=False))

    def forward(self, x: Tensor) -> Tensor:
        """Halves the resolution where the stride is 2."""
        hidden = functional.relu(self.first_norm(self.first(x)))
        return functional.relu(self.second_norm(self.second(hidden)) + self.shortcut(x))


class Detector3dNetwork(nn.Module):
    """Heatmaps and features at a quarter of the resolution, and regressions at chosen cells.

    Args:
        classes: number of classes.
        width: channels at a quarter of the resolution; coarser levels have more.
    """

    def __init__(self, classes: int, width: int) -> None:
        super().__init__()
        half = width // 2
        levels = (width, 2 * width, 3 * width, 4 * width)
        self.stem = nn.Conv2d(5, half, 3, 2, 1, bias=False)
        self.stem_norm = _norm(half)
        self.levels = nn.ModuleList(
            _Block(inputs, outputs, 2) for inputs, outputs in zip((half, *levels[:-1]), levels, strict=True)
        )
        self.laterals = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in levels)
        self.smooth = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.smooth_norm = _norm(width)
        self.heat_hidden = nn.Conv2d(width, width, 3, 1, 1)
        self.heat = nn.Conv2d(width, classes, 1)
        self.regression_hidden = nn.Linear(9 * width, 4 * width)
        self.regression = nn.Linear(4 * width, _REGRESSIONS)
        nn.init.constant_(self.get_parameter("heat.bias"), math.log(_FIRST_HEAT / (1 - _FIRST_HEAT)))
        nn.init.zeros_(self.regression.bias)

    def forward(self, images: Tensor, principal_points: Tensor) -> tuple[Tensor, Tensor]:
        """Computes where objects are, and the features that say what they are like.

        Args:
            images: [B, 3, H, W] sRGB in [0, 1].
            principal_points: [B, 2] x and y, pixels.

        Returns:
            Logits of the heatmaps [B, C, h, w], and features [B, F, h, w]; h and w are those of the padded image over
            ``STRIDE``.
        """
        x = functional.relu(self.stem_norm(self.stem(_prepare(images, principal_points))))
        features = []
        for level in self.levels:
            x = level(x)
            features.append(x)
        merged = self.laterals[-1](features[-1])
        for lateral, feature in zip(list(self.laterals)[-2::-1], features[-2::-1], strict=True):
            merged = functional.interpolate(merged, scale_factor=2.0, mode="nearest") + lateral(feature)
        shared = functional.relu(self.smooth_norm(self.smooth(merged)))
        heat = self.heat(functional.relu(self.heat_hidden(shared)))
        return heat, shared

    def regress(self, features: Tensor, images: Tensor, cells: Tensor) -> Regressions:
        """Reads off what objects are like.

        Args:
            features: [B, F, h, w] of :meth:`forward`.
            images: [N] index of the image of each object.
            cells: [N, 2] column and row of each.

        Returns:
            Regressions: at the N cells.
        """
        # A convolution of 3 × 3 cells, at a few cells only: over all of them it would take much longer.
        padded = functional.pad(features, (1, 1, 1, 1))
        steps = torch.arange(3)
        columns = cells[:, 0, None, None] + steps[None, None, :]
        rows = cells[:, 1, None, None] + steps[None, :, None]
        patches = padded[images[:, None, None], :, rows, columns].flatten(1)
        values = self.regression(functional.relu(self.regression_hidden(patches)))
        return Regressions(
            offsets=values[:, 0:2],
            log_depths=values[:, 2] + LOG_DEPTH,
            # Kept in a range in which neither the loss nor its gradient explodes.
            log_spreads=4.0 * torch.tanh(values[:, 3] / 4.0) - 1.0,
            log_sizes=values[:, 4:7],
            angles=values[:, 7:9],
        )


def _norm(channels: int) -> nn.Module:
    # Over groups and not over the batch: neighbouring frames of a street are too alike for a batch's statistics.
    return nn.GroupNorm(max(1, channels // _GROUP_CHANNELS), channels)


def _prepare(images: Tensor, principal_points: Tensor) -> Tensor:
    """Pads images, centres and scales their values, and adds places relative to the principal point."""
    height, width = images.shape[-2:]
    padded_height = math.ceil(height / PADDING) * PADDING
    padded_width = math.ceil(width / PADDING) * PADDING
    values = functional.pad((images - 0.45) / 0.25, (0, padded_width - width, 0, padded_height - height))
    columns = (torch.arange(padded_width) + 0.5 - principal_points[:, 0:1]) / _COORDINATE_PX
    rows = (torch.arange(padded_height) + 0.5 - principal_points[:, 1:2]) / _COORDINATE_PX
    places = torch.stack(
        [
            columns[:, None, :].expand(-1, padded_height, -1),
            rows[:, :, None].expand(-1, -1, padded_width),
        ],
        dim=1,
    )
    return torch.cat([values, places], 1).contiguous(memory_format=torch.channels_last)
