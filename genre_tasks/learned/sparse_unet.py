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

    Attributes:
        voxel_of: [N] the finest voxel of each point.
        count: number of finest voxels.
        neighbours: one 3×3×3 kernel map for each level.
        down: one 2×2×2 kernel map between each level and the next.
    """

    voxel_of: Tensor
    count: int
    neighbours: tuple[KernelMap, ...]
    down: tuple[KernelMap, ...]

    @staticmethod
    def from_keys(keys: Tensor, levels: int) -> VoxelPyramid:
        """Builds the levels and their kernel maps.

        Args:
            keys: [N] the voxel key of each point, see :func:`genre_tasks.learned.sparse_conv.pack_keys`; N may be 0.
            levels: number of levels, at least 1.
        """
        voxels, voxel_of = unique_voxels(keys)
        count = len(voxels)
        neighbours = [neighbour_map(voxels)]
        down = []
        for _ in range(levels - 1):
            voxels, kernel_map = coarsen(voxels)
            # The maps are all that the layers need; coordinates are not kept.
            down.append(kernel_map)
            neighbours.append(neighbour_map(voxels))
        return VoxelPyramid(voxel_of, count, tuple(neighbours), tuple(down))

    def pool(self, features: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Averages the features of points over the finest voxels.

        Args:
            features: [M, C].
            points: [M] which points these are.

        Returns:
            Means [n, C], 0 in a voxel without points; and the points in each voxel [n, 1], at least 1.
        """
        voxel = self.voxel_of[points]
        counts = torch.bincount(voxel, minlength=self.count).clamp_min(1).to(features.dtype)[:, None]
        # A mean, so that features keep their size however many Gaussians share a voxel.
        sums = features.new_zeros((self.count, features.shape[1])).index_add(0, voxel, features)
        return sums / counts, counts


class SparseConv(nn.Module):
    """A sparse convolution with bias.

    Args:
        offsets: number of kernel offsets K.
        channels_in: C.
        channels_out: D.
        expected: occupied neighbours that a voxel usually has, which set the size of the initial weights.
    """

    def __init__(self, offsets: int, channels_in: int, channels_out: int, expected: int) -> None:
        super().__init__()
        # Keeps the variance of features, with the neighbours that are there instead of all that there could be.
        self.weight = nn.Parameter(torch.randn(offsets, channels_in, channels_out) / (expected * channels_in) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(channels_out))

    def forward(self, features: Tensor, kernel_map: KernelMap) -> Tensor:
        """Convolves the features of voxels.

        Args:
            features: [n, C].
            kernel_map: from the n input voxels to m output voxels.

        Returns:
            [m, D].
        """
        return sparse_conv(features, self.weight, kernel_map) + self.bias


class SparseUNet(nn.Module):
    """A UNet over the levels of a :class:`VoxelPyramid`, with skip connections.

    Each level has one residual 3×3×3 convolution on the way down, and all but the coarsest have one on the way up.

    Args:
        channels_in: channels of its input on the finest voxels.
        channels: channels of the levels, finest first.
    """

    def __init__(self, channels_in: int, channels: Sequence[int]) -> None:
        super().__init__()
        pairs = list(pairwise(channels))
        # Of 27 neighbours about 8 are occupied on a surface, of 8 children about 3; a child has one parent.
        self.entry = nn.Linear(channels_in, channels[0])
        self.encode = nn.ModuleList([SparseConv(27, c, c, 8) for c in channels])
        self.narrow = nn.ModuleList([SparseConv(8, c, d, 3) for c, d in pairs])
        self.widen = nn.ModuleList([SparseConv(8, d, c, 1) for c, d in pairs])
        self.decode = nn.ModuleList([SparseConv(27, c, c, 8) for c in channels[:-1]])

    def forward(self, features: Tensor, pyramid: VoxelPyramid) -> Tensor:
        """Gives every finest voxel its spatial context.

        Args:
            features: [n, channels_in] on the finest voxels.
            pyramid: with as many levels as the network has.

        Returns:
            [n, channels[0]].
        """
        x = F.silu(self.entry(features))
        skips = []
        for level, convolution in enumerate(self.encode):
            # Residual, so that a voxel without neighbours keeps its features.
            x = x + F.silu(convolution(x, pyramid.neighbours[level]))
            if level < len(self.narrow):
                skips.append(x)
                x = F.silu(self.narrow[level](x, pyramid.down[level]))
        # Skips are added, not concatenated: finer levels keep their few channels.
        for level in reversed(range(len(self.widen))):
            x = skips[level] + F.silu(self.widen[level](x, pyramid.down[level].transposed()))
            x = x + F.silu(self.decode[level](x, pyramid.neighbours[level]))
        return x
