"""The sparse UNet as a list of layers for the compiled kernel: padded weights, and kernel maps grouped by output."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from genre_tasks.learned.sparse_conv import KernelMap
from genre_tasks.learned.sparse_unet import SparseConv, SparseUNet, VoxelPyramid
from genre_tasks.optimiser.kernels.library import Layer

LANES = 16
"""Channels are padded with zeros to a multiple of this, the floats of the widest vector register."""


class KernelMemory:
    """Keeps the tensors alive whose addresses the kernel has."""

    def __init__(self) -> None:
        self._tensors: list[Tensor] = []

    def address(self, tensor: Tensor) -> int:
        """Registers a tensor, or a contiguous copy of it.

        Args:
            tensor: what the kernel is to read or write.

        Returns:
            Its address, valid for as long as this object lives.
        """
        # A contiguous copy has no other owner: unregistered, it would be freed before the kernel reads it.
        self._tensors.append(tensor.detach().contiguous())
        return self._tensors[-1].data_ptr()


def pad_with_zeros(tensor: Tensor, *shape: int) -> Tensor:
    """Copies a tensor into the corner of a larger one.

    Args:
        tensor: what to copy.
        shape: the result's shape, nowhere smaller.

    Returns:
        The larger tensor, zero outside of ``tensor``.

    >>> pad_with_zeros(torch.ones(1, 2), 2, 3)
    tensor([[1., 1., 0.],
            [0., 0., 0.]])
    """
    # Zero weights keep padded channels at zero through every layer, so that results do not change.
    out = torch.zeros(shape)
    out[tuple(slice(0, n) for n in tensor.shape)] = tensor.detach()
    return out


def round_up(n: int, multiple: int) -> int:
    """Rounds a number up to a multiple of another.

    Args:
        n: at least 0.
        multiple: at least 1.

    >>> round_up(17, 16), round_up(16, 16)
    (32, 16)
    """
    return -(-n // multiple) * multiple


@dataclass(frozen=True)
class IndexGroups:
    """Indices of entries, grouped by a label that each entry has.

    Attributes:
        starts: [labels + 1] int32; the entries of label k are ``order[starts[k]:starts[k + 1]]``, ascending.
        order: [P] int32.
    """

    starts: Tensor
    order: Tensor

    @staticmethod
    def from_labels(labels: Tensor, count: int) -> IndexGroups:
        """Groups entries by their labels.

        Args:
            labels: [P] int64 in [0, count).
            count: number of labels.
        """
        starts = torch.zeros(count + 1, dtype=torch.int32)
        starts[1:] = torch.bincount(labels, minlength=count).cumsum(0)
        # A stable sort keeps the entries of a label in order, and with them the order of the kernel's sums.
        return IndexGroups(starts, torch.argsort(labels, stable=True).to(torch.int32))


@dataclass(frozen=True)
class PairsByOutput:
    """A kernel map grouped by output voxel, so that each output can be computed by one thread on its own.

    Attributes:
        starts: [m + 1] int32; output o has the pairs ``pairs[starts[o]:starts[o + 1]]``.
        pairs: [P, 2] int32 input voxel and kernel offset; offsets ascend within an output.
    """

    starts: Tensor
    pairs: Tensor

    @staticmethod
    def from_kernel_map(kernel_map: KernelMap) -> PairsByOutput:
        """Lists the pairs of a kernel map by output; sums keep their order.

        Args:
            kernel_map: grouped by kernel offset.
        """
        starts = torch.tensor(kernel_map.starts)
        offset = torch.repeat_interleave(torch.arange(len(starts) - 1), starts.diff())
        # Pairs are sorted by offset already, so that offsets ascend within an output, as in torch's sums.
        groups = IndexGroups.from_labels(kernel_map.outputs, kernel_map.output_count)
        pairs = torch.stack([kernel_map.inputs, offset], 1)[groups.order.long()]
        return PairsByOutput(groups.starts, pairs.int())

    @staticmethod
    def identity(count: int) -> PairsByOutput:
        """Makes the map of a linear layer: each voxel has itself as its only input.

        Args:
            count: number of voxels.
        """
        # One start more than there are voxels: it ends the last group.
        voxels = torch.arange(count + 1, dtype=torch.int32)
        return PairsByOutput(voxels, torch.stack([voxels, torch.zeros_like(voxels)], 1)[:count])


class LayerProgram:
    """A list of layers in the order in which the kernel runs them; it owns their outputs.

    Args:
        memory: keeps what the layers read and write alive.
    """

    def __init__(self, memory: KernelMemory) -> None:
        self._memory = memory
        self._layers: list[Layer] = []

    def add(
        self,
        source: Tensor,  # [n, padded C]
        weight: Tensor,  # [K, C, D]
        bias: Tensor,  # [D]
        pairs: PairsByOutput,
        residual: Tensor | None = None,  # [m, padded D]
        multiple: int = LANES,
        activated: bool = True,
    ) -> Tensor:
        """Appends one layer, which computes ``residual + silu(Σ source @ weight + bias)``.

        Args:
            source: its input, filled by the layers before it.
            weight: one matrix for each kernel offset.
            bias: added to each output.
            pairs: from n input voxels to m output voxels.
            residual: added after the activation; ``None``: nothing.
            multiple: D is padded to a multiple of this.
            activated: whether there is an activation.

        Returns:
            [m, padded D] where the output will be.
        """
        count = len(pairs.starts) - 1
        width = round_up(weight.shape[2], multiple)
        out = torch.zeros(count, width)
        address = self._memory.address
        # By position, in the order of the structure's fields: ctypes ignores a keyword that names none of them.
        layer = Layer(
            address(source),
            address(pad_with_zeros(weight, len(weight), source.shape[1], width)),
            address(pad_with_zeros(bias, width)),
            None if residual is None else address(residual),
            address(out),
            address(pairs.starts),
            address(pairs.pairs),
            count,
            source.shape[1],
            width,
            activated,
        )
        self._layers.append(layer)
        return out

    def add_unet(self, unet: SparseUNet, pooled: Tensor, pyramid: VoxelPyramid) -> Tensor:
        """Appends the layers of a UNet.

        Args:
            unet: the network, whose weights are copied.
            pooled: [n, padded channels] its input on the finest voxels.
            pyramid: the scene's voxels.

        Returns:
            [n, padded channels[0]] where its output will be.
        """
        # Kernel maps depend on voxels alone: each is regrouped once, for all layers of its level.
        neighbours = [PairsByOutput.from_kernel_map(m) for m in pyramid.neighbours]
        down = [PairsByOutput.from_kernel_map(m) for m in pyramid.down]
        # Up-sampling takes the pairs of down-sampling backwards.
        up = [PairsByOutput.from_kernel_map(m.transposed()) for m in pyramid.down]
        skips = []
        # A linear layer is one of voxels without neighbours: the kernel has one kind of layer only.
        x = self.add(pooled, unet.entry.weight.T[None], unet.entry.bias, PairsByOutput.identity(len(pooled)))
        for level, convolution in enumerate(unet.encode):
            x = self._add_convolution(convolution, x, neighbours[level], x)
            if level < len(unet.narrow):
                # Outputs stay where they are, so that a skip connection is the address of an earlier one.
                skips.append(x)
                x = self._add_convolution(unet.narrow[level], x, down[level])
        for level in reversed(range(len(unet.widen))):
            x = self._add_convolution(unet.widen[level], x, up[level], skips[level])
            x = self._add_convolution(unet.decode[level], x, neighbours[level], x)
        return x

    def as_array(self) -> ctypes.Array[Layer]:
        """All layers as the array that the kernel takes."""
        return (Layer * len(self._layers))(*self._layers)

    def _add_convolution(
        self, layer: nn.Module, source: Tensor, pairs: PairsByOutput, residual: Tensor | None = None
    ) -> Tensor:
        assert isinstance(layer, SparseConv)
        return self.add(source, layer.weight, layer.bias, pairs, residual)
