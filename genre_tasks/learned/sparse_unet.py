"""A small UNet over sparse voxels: spatial context for the learned optimiser (paper Sec. III-C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from genre_tasks.learned.sparse_conv import KernelMap, coarsen, neighbour_map, sparse_conv, unique_voxels


@dataclass(frozen=True)
class VoxelPyramid:
    """The structure that the UNet works on: levels of voxels, each twice as wide as the one before.

    ``voxel_of`` [N]: the finest voxel of each point; ``count``: finest voxels; ``neighbours``: one 3×3×3 map a level;
    ``down``: one 2×2×2 map between a level and the next.
    """

    voxel_of: Tensor
    count: int
    neighbours: tuple[KernelMap, ...]
    down: tuple[KernelMap, ...]

    @staticmethod
    def of(keys: Tensor, levels: int) -> VoxelPyramid:
        """From the voxel key [N] of each point (see :func:`genre_tasks.learned.sparse_conv.pack`); N may be 0."""
        voxels, voxel_of = unique_voxels(keys)
        count, neighbours, down = len(voxels), [neighbour_map(voxels)], []
        for _ in range(levels - 1):
            voxels, kernel_map = coarsen(voxels)
            down.append(kernel_map)
            neighbours.append(neighbour_map(voxels))
        return VoxelPyramid(voxel_of, count, tuple(neighbours), tuple(down))

    def pool(self, features: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the features [M, C] of the ``points`` [M] in each finest voxel, [n, C], 0 where there are none.

        And their number, [n, 1], at least 1.
        """
        voxel = self.voxel_of[points]
        counts = torch.bincount(voxel, minlength=self.count).clamp_min(1).to(features.dtype)[:, None]
        return features.new_zeros((self.count, features.shape[1])).index_add(0, voxel, features) / counts, counts


class SparseConv(nn.Module):
    """A sparse convolution with bias; initialised as a dense one whose voxels have ``expected`` occupied neighbours."""

    def __init__(self, offsets: int, channels_in: int, channels_out: int, expected: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(offsets, channels_in, channels_out) / (expected * channels_in) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(channels_out))

    def forward(self, features: Tensor, kernel_map: KernelMap) -> Tensor:
        """[n, C] → [m, D]."""
        return sparse_conv(features, self.weight, kernel_map) + self.bias


class SparseUNet(nn.Module):
    """Down and up again with skip connections; [n, C] on the finest voxels → [n, channels[0]].

    Each level has one 3×3×3 residual convolution on the way down and, but for the coarsest, one on the way up.
    """

    def __init__(self, channels_in: int, channels: Sequence[int]) -> None:
        super().__init__()
        pairs = list(pairwise(channels))
        self.entry = nn.Linear(channels_in, channels[0])
        self.encode = nn.ModuleList([SparseConv(27, c, c, 8) for c in channels])
        self.narrow = nn.ModuleList([SparseConv(8, c, d, 3) for c, d in pairs])
        self.widen = nn.ModuleList([SparseConv(8, d, c, 1) for c, d in pairs])
        self.decode = nn.ModuleList([SparseConv(27, c, c, 8) for c in channels[:-1]])

    def forward(self, features: Tensor, pyramid: VoxelPyramid) -> Tensor:
        """The pyramid needs as many levels as the network has."""
        x = F.silu(self.entry(features))
        skips = []
        for level, convolution in enumerate(self.encode):
            x = x + F.silu(convolution(x, pyramid.neighbours[level]))
            if level < len(self.narrow):
                skips.append(x)
                x = F.silu(self.narrow[level](x, pyramid.down[level]))
        for level in reversed(range(len(self.widen))):
            x = skips[level] + F.silu(self.widen[level](x, pyramid.down[level].transposed()))
            x = x + F.silu(self.decode[level](x, pyramid.neighbours[level]))
        return x
