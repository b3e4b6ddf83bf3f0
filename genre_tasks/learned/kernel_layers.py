"""The sparse UNet as a list of layers for the compiled kernel: padded weights, and kernel maps by output."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from genre_tasks.learned.sparse_conv import KernelMap
from genre_tasks.learned.sparse_unet import SparseConv, SparseUNet, VoxelPyramid
from genre_tasks.optimiser.kernels.library import Layer

LANES = 16
"""Channels are padded with zeros to a multiple of this."""


class Memory:
    """Tensors that the kernel reads and writes, kept alive with their addresses."""

    def __init__(self) -> None:
        self._kept: list[Tensor] = []

    def address(self, tensor: Tensor) -> int:
        """Of ``tensor``, or of a contiguous copy."""
        self._kept.append(tensor.detach().contiguous())
        return self._kept[-1].data_ptr()


def padded(tensor: Tensor, *shape: int) -> Tensor:
    """With zeros up to ``shape``."""
    out = torch.zeros(shape)
    out[tuple(slice(0, n) for n in tensor.shape)] = tensor.detach()
    return out


def round_up(n: int, multiple: int) -> int:
    """The next multiple of ``multiple``, or ``n`` where it is one."""
    return -(-n // multiple) * multiple


@dataclass(frozen=True)
class ByOwner:
    """Entries sorted by owner: those of owner o are ``order[starts[o]:starts[o + 1]]``, ascending; int32."""

    starts: Tensor
    order: Tensor

    @staticmethod
    def of(owner: Tensor, count: int) -> ByOwner:
        """From the owner [P] of each entry."""
        starts = torch.zeros(count + 1, dtype=torch.int32)
        starts[1:] = torch.bincount(owner, minlength=count).cumsum(0)
        return ByOwner(starts, torch.argsort(owner, stable=True).to(torch.int32))


@dataclass(frozen=True)
class Pairs:
    """A kernel map by output: (input, kernel offset) ``pairs[starts[o]:starts[o + 1]]``, offsets ascending; int32."""

    starts: Tensor
    pairs: Tensor

    @staticmethod
    def of(kernel_map: KernelMap) -> Pairs:
        """The same sums, listed by output."""
        firsts = torch.tensor(kernel_map.starts)
        offset = torch.repeat_interleave(torch.arange(len(firsts) - 1), firsts.diff())
        by_output = ByOwner.of(kernel_map.outputs, kernel_map.output_count)
        return Pairs(by_output.starts, torch.stack([kernel_map.inputs, offset], 1)[by_output.order.long()].int())

    @staticmethod
    def identity(count: int) -> Pairs:
        """Each voxel by itself: a linear layer."""
        each = torch.arange(count + 1, dtype=torch.int32)
        return Pairs(each, torch.stack([each, torch.zeros_like(each)], 1)[:count])


class Layers:
    """A list of layers in the order in which they run; their outputs are made here."""

    def __init__(self, memory: Memory) -> None:
        self._memory, self._made = memory, list[Layer]()

    def add(
        self,
        source: Tensor,  # [n, padded C]
        weight: Tensor,  # [K, C, D]
        bias: Tensor,  # [D]
        pairs: Pairs,
        residual: Tensor | None = None,  # [m, padded D]
        multiple: int = LANES,
        activated: bool = True,
    ) -> Tensor:
        """Where ``residual + silu(Σ source @ weight + bias)`` will be, [m, D padded to ``multiple``]."""
        count, width, at = len(pairs.starts) - 1, round_up(weight.shape[2], multiple), self._memory.address
        out = torch.zeros(count, width)
        self._made.append(
            Layer(
                at(source),
                at(padded(weight, len(weight), source.shape[1], width)),
                at(padded(bias, width)),
                None if residual is None else at(residual),
                at(out),
                at(pairs.starts),
                at(pairs.pairs),
                count,
                source.shape[1],
                width,
                activated,
            )
        )
        return out

    def unet(self, unet: SparseUNet, pooled: Tensor, pyramid: VoxelPyramid) -> Tensor:
        """The layers of ``unet``; where its result will be, [n, padded channels[0]]."""
        neighbours = [Pairs.of(m) for m in pyramid.neighbours]
        down, up = [Pairs.of(m) for m in pyramid.down], [Pairs.of(m.transposed()) for m in pyramid.down]
        skips = []
        x = self.add(pooled, unet.entry.weight.T[None], unet.entry.bias, Pairs.identity(len(pooled)))
        for level, convolution in enumerate(unet.encode):
            x = self._convolution(convolution, x, neighbours[level], x)
            if level < len(unet.narrow):
                skips.append(x)
                x = self._convolution(unet.narrow[level], x, down[level])
        for level in reversed(range(len(unet.widen))):
            x = self._convolution(unet.widen[level], x, up[level], skips[level])
            x = self._convolution(unet.decode[level], x, neighbours[level], x)
        return x

    def program(self) -> ctypes.Array[Layer]:
        """All of them, as the kernel takes them."""
        return (Layer * len(self._made))(*self._made)

    def _convolution(self, layer: nn.Module, source: Tensor, pairs: Pairs, residual: Tensor | None = None) -> Tensor:
        assert isinstance(layer, SparseConv)
        return self.add(source, layer.weight, layer.bias, pairs, residual)
