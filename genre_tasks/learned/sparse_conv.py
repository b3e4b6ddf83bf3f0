"""Sparse convolution in plain torch: voxels as sorted keys, kernel maps, gather – matrix product – index_add.

A voxel is (batch, x, y, z) packed into one int64; voxels of different batches never touch. A kernel map lists, offset
by offset, which input voxel feeds which output voxel; it is built once per structure and serves every layer of that
level. Within an offset every output occurs once, and sums over offsets run in one fixed order: the result is the same
at any thread count.
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
HALF = 1 << (BITS - 1)
"""Coordinates lie in [−HALF + 1, HALF − 2], so that a neighbour never wraps into another row; others are clamped."""
MAX_BATCHES = 1 << 14

OFFSETS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1))
CORNERS = tuple((x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1))


@dataclass(frozen=True)
class KernelMap:
    """Pairs of voxels, grouped by kernel offset.

    ``inputs`` and ``outputs`` [P] int64; offset k owns the pairs ``starts[k]:starts[k + 1]``.
    """

    inputs: Tensor
    outputs: Tensor
    starts: tuple[int, ...]
    input_count: int
    output_count: int

    def transposed(self) -> KernelMap:
        """The map that takes outputs back to inputs (for up-sampling)."""
        return KernelMap(self.outputs, self.inputs, self.starts, self.output_count, self.input_count)


def pack(batch: Tensor, coordinates: Tensor) -> Tensor:
    """Keys [N] int64 of ``batch`` [N] in [0, MAX_BATCHES) and integer ``coordinates`` [N, 3]."""
    if len(batch) and (int(batch.min()) < 0 or int(batch.max()) >= MAX_BATCHES):
        raise ValueError(f"expected batches in [0, {MAX_BATCHES}), got {int(batch.min())} … {int(batch.max())}")
    x, y, z = (coordinates.clamp(-HALF + 1, HALF - 2) + HALF).unbind(-1)
    return ((batch << (3 * BITS)) | (x << (2 * BITS))) | (y << BITS) | z


def unpack(keys: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of :func:`pack`: batch [N], coordinates [N, 3]."""
    mask = (1 << BITS) - 1
    axes = [((keys >> shift) & mask) - HALF for shift in (2 * BITS, BITS, 0)]
    return keys >> (3 * BITS), torch.stack(axes, -1)


def unique_voxels(keys: Tensor) -> tuple[Tensor, Tensor]:
    """Sorted unique keys [n], and for each input key its voxel [N]."""
    return torch.unique(keys, sorted=True, return_inverse=True)


def neighbour_map(keys: Tensor) -> KernelMap:
    """The 3×3×3 map of a level onto itself; ``keys`` [n] sorted and unique. Offset k reads the voxel at +OFFSETS[k]."""
    inputs, outputs = [], []
    everyone = torch.arange(len(keys), device=keys.device)
    for x, y, z in OFFSETS:
        if (x, y, z) == (0, 0, 0):
            inputs.append(everyone)
            outputs.append(everyone)
            continue
        wanted = keys + ((x << (2 * BITS)) + (y << BITS) + z)
        at = torch.searchsorted(keys, wanted).clamp_max(max(len(keys) - 1, 0))
        found = torch.nonzero(keys[at] == wanted)[:, 0] if len(keys) else everyone
        inputs.append(at[found])
        outputs.append(found)
    return _joined(inputs, outputs, len(keys), len(keys))


def coarsen(keys: Tensor) -> tuple[Tensor, KernelMap]:
    """The next level, of voxels twice as wide, and the 2×2×2 map from ``keys`` [n] (sorted, unique) to it."""
    batch, coordinates = unpack(keys)
    coarse, parent = unique_voxels(pack(batch, torch.div(coordinates, 2, rounding_mode="floor")))
    corner = coordinates & 1
    kind = corner[:, 0] * 4 + corner[:, 1] * 2 + corner[:, 2]
    order = torch.argsort(kind, stable=True)
    inputs = [order[kind[order] == k] for k in range(len(CORNERS))]
    return coarse, _joined(inputs, [parent[i] for i in inputs], len(keys), len(coarse))


def sparse_conv(
    features: Tensor,  # [n, C]
    weight: Tensor,  # [K, C, D]
    kernel_map: KernelMap,
) -> Tensor:  # [m, D]
    """Σ over pairs: ``out[outputs] += features[inputs] @ weight[offset]``; differentiable in both.

    Raises ``ValueError`` for a shape that does not fit the map.
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
        products = _by_offset(gathered, weight, kernel_map.starts)
        ctx.save_for_backward(gathered, weight)
        ctx.kernel_map = kernel_map
        out = features.new_zeros((kernel_map.output_count, weight.shape[2]))
        return out.index_add_(0, kernel_map.outputs, products)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        gathered, weight = ctx.saved_tensors
        maps: KernelMap = ctx.kernel_map
        pairs = grad.index_select(0, maps.outputs)
        by_features = by_weight = None
        if ctx.needs_input_grad[0]:
            products = _by_offset(pairs, weight.transpose(1, 2), maps.starts)
            by_features = grad.new_zeros((maps.input_count, weight.shape[1])).index_add_(0, maps.inputs, products)
        if ctx.needs_input_grad[1]:
            by_weight = torch.stack([gathered[a:b].T @ pairs[a:b] for a, b in pairwise(maps.starts)])
        return by_features, by_weight, None


def _by_offset(rows: Tensor, weight: Tensor, starts: Sequence[int]) -> Tensor:
    """Each offset's rows times that offset's matrix, [P, C] × [K, C, D] → [P, D]."""
    out = rows.new_empty((len(rows), weight.shape[2]))
    for k, (a, b) in enumerate(pairwise(starts)):
        if b > a:
            torch.mm(rows[a:b], weight[k], out=out[a:b])
    return out


def _joined(inputs: list[Tensor], outputs: list[Tensor], input_count: int, output_count: int) -> KernelMap:
    starts = [0]
    for part in inputs:
        starts.append(starts[-1] + len(part))
    return KernelMap(torch.cat(inputs), torch.cat(outputs), tuple(starts), input_count, output_count)
