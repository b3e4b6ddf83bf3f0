"""Sparse convolution in plain torch: voxels as sorted keys, kernel maps, and gather – matrix product – index_add.

A voxel is (batch, x, y, z) packed into one int64; voxels of different batches never touch. A kernel map lists, offset
by offset, which input voxel feeds which output voxel. It is built once for a structure and serves every layer of that
level. Within an offset every output occurs once, and sums over offsets run in one fixed order, so that the result is
the same at any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

BITS = 16
"""Bits of a key for each coordinate."""

HALF = 1 << (BITS - 1)
"""Coordinates lie in [−HALF + 1, HALF − 2], so that a neighbour never wraps into another row; others are clamped."""

MAX_BATCHES = 1 << 14
"""Batch numbers lie above the bits of the coordinates; below this bound keys stay positive."""

OFFSETS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1))
"""Offsets of a 3×3×3 kernel, in the order of its weights."""

CORNERS = tuple((x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1))
"""Offsets of a 2×2×2 kernel, in the order of its weights."""


@dataclass(frozen=True)
class KernelMap:
    """Which input voxel feeds which output voxel of a sparse convolution, grouped by kernel offset.

    Attributes:
        inputs: [P] int64 input voxel of each pair.
        outputs: [P] int64 output voxel of each pair.
        starts: offset k has the pairs ``starts[k]:starts[k + 1]``.
        input_count: number of input voxels.
        output_count: number of output voxels.
    """

    inputs: Tensor
    outputs: Tensor
    starts: tuple[int, ...]
    input_count: int
    output_count: int

    def transposed(self) -> KernelMap:
        """The map that takes outputs back to inputs, for up-sampling."""
        return KernelMap(self.outputs, self.inputs, self.starts, self.output_count, self.input_count)


def pack_keys(batch: Tensor, coordinates: Tensor) -> Tensor:
    """Packs batch numbers and voxel coordinates into sortable keys.

    Args:
        batch: [N] int64 in [0, MAX_BATCHES).
        coordinates: [N, 3] int64; clamped to the range of 16 bits.

    Returns:
        [N] int64.

    Raises:
        ValueError: a batch number is out of range.

    >>> keys = pack_keys(torch.tensor([2]), torch.tensor([[1, -5, 7]]))
    >>> unpack_keys(keys)
    (tensor([2]), tensor([[ 1, -5,  7]]))
    """
    if len(batch) and (int(batch.min()) < 0 or int(batch.max()) >= MAX_BATCHES):
        raise ValueError(f"expected batches in [0, {MAX_BATCHES}), got {int(batch.min())} … {int(batch.max())}")
    # From 0 on, so that keys sort by coordinates, and a neighbour is one addition away.
    x, y, z = (coordinates.clamp(-HALF + 1, HALF - 2) + HALF).unbind(-1)
    return ((batch << (3 * BITS)) | (x << (2 * BITS))) | (y << BITS) | z


def unpack_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Inverts :func:`pack_keys`.

    Args:
        keys: [N] int64.

    Returns:
        Batch numbers [N] and coordinates [N, 3].
    """
    mask = (1 << BITS) - 1
    axes = [((keys >> shift) & mask) - HALF for shift in (2 * BITS, BITS, 0)]
    return keys >> (3 * BITS), torch.stack(axes, -1)


def unique_voxels(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Finds the voxels that occur.

    Args:
        keys: [N] int64.

    Returns:
        The sorted unique keys [n], and the voxel of each input key [N].
    """
    return torch.unique(keys, sorted=True, return_inverse=True)


def neighbour_map(keys: Tensor) -> KernelMap:
    """Builds the kernel map of a 3×3×3 convolution from a level onto itself.

    Args:
        keys: [n] sorted and unique.

    Returns:
        A map whose offset k reads the voxel at +OFFSETS[k].
    """
    inputs = []
    outputs = []
    everyone = torch.arange(len(keys), device=keys.device)
    for x, y, z in OFFSETS:
        # The centre needs no search.
        if (x, y, z) == (0, 0, 0):
            inputs.append(everyone)
            outputs.append(everyone)
            continue
        wanted = keys + ((x << (2 * BITS)) + (y << BITS) + z)
        # Where the neighbour would be; it is there only if the key at that position is the wanted one.
        position = torch.searchsorted(keys, wanted).clamp_max(max(len(keys) - 1, 0))
        found = torch.nonzero(keys[position] == wanted)[:, 0] if len(keys) else everyone
        inputs.append(position[found])
        outputs.append(found)
    return _join_offsets(inputs, outputs, len(keys), len(keys))


def coarsen(keys: Tensor) -> tuple[Tensor, KernelMap]:
    """Builds the next level, whose voxels are twice as wide, and the 2×2×2 map to it.

    Args:
        keys: [n] sorted and unique.

    Returns:
        The keys of the coarse level [m], sorted and unique, and the map from ``keys`` to them.
    """
    batch, coordinates = unpack_keys(keys)
    # Rounding down, not towards zero, so that voxels on both sides of the origin have two children along each axis.
    coarse, parent = unique_voxels(pack_keys(batch, torch.div(coordinates, 2, rounding_mode="floor")))
    corner = coordinates & 1
    corner_index = corner[:, 0] * 4 + corner[:, 1] * 2 + corner[:, 2]
    # Stable, so that the pairs of an offset keep the order of the voxels.
    order = torch.argsort(corner_index, stable=True)
    inputs = [order[corner_index[order] == k] for k in range(len(CORNERS))]
    return coarse, _join_offsets(inputs, [parent[i] for i in inputs], len(keys), len(coarse))


def sparse_conv(
    features: Tensor,  # [n, C]
    weight: Tensor,  # [K, C, D]
    kernel_map: KernelMap,
) -> Tensor:  # [m, D]
    """Convolves voxel features: ``out[outputs] += features[inputs] @ weight[offset]`` over all pairs.

    Args:
        features: features of the input voxels.
        weight: one matrix for each kernel offset.
        kernel_map: from n input voxels to m output voxels.

    Returns:
        Features of the output voxels, differentiable in ``features`` and ``weight``.

    Raises:
        ValueError: a shape does not fit the map.
    """
    offsets = len(kernel_map.starts) - 1
    if (
        features.ndim != 2
        or len(features) != kernel_map.input_count
        or weight.shape[:2] != (offsets, features.shape[1])
    ):
        raise ValueError(
            f"expected features [{kernel_map.input_count}, C] and weight [{offsets}, C, D], "
            f"got {list(features.shape)} and {list(weight.shape)}"
        )
    return _SparseConv.apply(features, weight, kernel_map)


class _SparseConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
        gathered = features.index_select(0, kernel_map.inputs)
        products = _multiply_by_offset(gathered, weight, kernel_map.starts)
        # The gathered rows serve the gradient of the weights, which would otherwise gather them again.
        ctx.save_for_backward(gathered, weight)
        ctx.kernel_map = kernel_map
        out = features.new_zeros((kernel_map.output_count, weight.shape[2]))
        # On the CPU index_add_ sums in the order of the pairs, that is offset by offset.
        return out.index_add_(0, kernel_map.outputs, products)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        gathered, weight = ctx.saved_tensors
        kernel_map: KernelMap = ctx.kernel_map
        # Backwards, inputs and outputs change their roles.
        pair_grads = grad.index_select(0, kernel_map.outputs)
        by_features = None
        by_weight = None
        if ctx.needs_input_grad[0]:
            products = _multiply_by_offset(pair_grads, weight.transpose(1, 2), kernel_map.starts)
            by_features = grad.new_zeros((kernel_map.input_count, weight.shape[1]))
            by_features = by_features.index_add_(0, kernel_map.inputs, products)
        if ctx.needs_input_grad[1]:
            by_weight = torch.stack([gathered[a:b].T @ pair_grads[a:b] for a, b in pairwise(kernel_map.starts)])
        return by_features, by_weight, None


def _multiply_by_offset(rows: Tensor, weight: Tensor, starts: Sequence[int]) -> Tensor:
    """Each offset's rows times that offset's matrix, [P, C] × [K, C, D] → [P, D]."""
    # All products into one buffer: joining a list of them would copy each once more.
    out = rows.new_empty((len(rows), weight.shape[2]))
    for k, (start, end) in enumerate(pairwise(starts)):
        if end > start:
            torch.mm(rows[start:end], weight[k], out=out[start:end])
    return out


def _join_offsets(inputs: list[Tensor], outputs: list[Tensor], input_count: int, output_count: int) -> KernelMap:
    """A kernel map from the pairs of each offset."""
    starts = [0]
    for pairs in inputs:
        starts.append(starts[-1] + len(pairs))
    return KernelMap(torch.cat(inputs), torch.cat(outputs), tuple(starts), input_count, output_count)
