"""Sparse convolution against a dense one, and its edge cases."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from genre_tasks.learned.sparse_conv import (
    CORNERS,
    HALF,
    OFFSETS,
    coarsen,
    neighbour_map,
    pack_keys,
    sparse_conv,
    unique_voxels,
    unpack_keys,
)
from genre_tasks.learned.sparse_unet import SparseUNet, VoxelPyramid

SIDE = 6


def _grid(seed: int, occupied: float = 0.4) -> torch.Tensor:
    mask = torch.rand(SIDE, SIDE, SIDE, generator=torch.Generator().manual_seed(seed)) < occupied
    return torch.nonzero(mask)


def _dense(features: torch.Tensor, coordinates: torch.Tensor) -> torch.Tensor:
    volume = features.new_zeros((features.shape[1], SIDE, SIDE, SIDE))
    flat = (coordinates[:, 0] * SIDE + coordinates[:, 1]) * SIDE + coordinates[:, 2]
    return volume.flatten(1).index_copy(1, flat, features.T).view_as(volume)


def test_pack_and_unpack_are_inverse_and_sorted_like_tuples() -> None:
    batch = torch.tensor([0, 0, 3, 3])
    xyz = torch.tensor([[-5, 2, 7], [0, 0, 0], [-HALF + 1, HALF - 2, 0], [1, -1, 1]])
    keys = pack_keys(batch, xyz)
    back, coordinates = unpack_keys(keys)
    assert torch.equal(back, batch) and torch.equal(coordinates, xyz)
    assert sorted(keys.tolist()) == [
        k
        for _, k in sorted(
            zip([(b, *c) for b, c in zip(batch.tolist(), xyz.tolist(), strict=True)], keys.tolist(), strict=True)
        )
    ]


def test_batches_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="expected batches"):
        pack_keys(torch.tensor([-1]), torch.zeros(1, 3, dtype=torch.long))


def test_values_and_gradients_equal_a_dense_convolution() -> None:
    coordinates = _grid(0)
    keys = pack_keys(torch.zeros(len(coordinates), dtype=torch.long), coordinates)  # nonzero() is sorted already
    torch.manual_seed(1)
    f = torch.randn(len(coordinates), 5, requires_grad=True)
    w = torch.randn(27, 5, 4, requires_grad=True)
    out = sparse_conv(f, w, neighbour_map(keys))
    kernel = w.permute(2, 1, 0).reshape(4, 5, 3, 3, 3)  # OFFSETS run x slowest, as the dense kernel's axes
    dense = F.conv3d(_dense(f, coordinates)[None], kernel, padding=1)[0]
    expected = dense[(slice(None), *coordinates.unbind(1))].T
    torch.testing.assert_close(out, expected, atol=1e-5, rtol=1e-5)
    cotangent = torch.randn_like(out)
    got = torch.autograd.grad((out * cotangent).sum(), (f, w))
    want = torch.autograd.grad((expected * cotangent).sum(), (f, w))
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_strided_and_transposed_equal_dense_ones() -> None:
    coordinates = _grid(2)
    keys = pack_keys(torch.zeros(len(coordinates), dtype=torch.long), coordinates)
    coarse, kernel_map = coarsen(keys)
    torch.manual_seed(3)
    f, w = torch.randn(len(keys), 3), torch.randn(8, 3, 2)
    kernel = w.permute(2, 1, 0).reshape(2, 3, 2, 2, 2)
    dense = F.conv3d(_dense(f, coordinates)[None], kernel, stride=2)[0]
    at = unpack_keys(coarse)[1]
    torch.testing.assert_close(
        sparse_conv(f, w, kernel_map), dense[(slice(None), *at.unbind(1))].T, atol=1e-5, rtol=1e-5
    )
    up = torch.randn(8, 2, 3)
    g = torch.randn(len(coarse), 2)
    back = sparse_conv(g, up, kernel_map.transposed())
    for i, c in enumerate(coordinates):
        corner = CORNERS.index(tuple((c & 1).tolist()))
        parent = int(torch.nonzero((at == c // 2).all(1))[0, 0])
        torch.testing.assert_close(back[i], g[parent] @ up[corner], atol=1e-5, rtol=1e-5)


def test_negative_coordinates_coarsen_downwards() -> None:
    keys = unique_voxels(
        pack_keys(torch.zeros(3, dtype=torch.long), torch.tensor([[-1, -1, -1], [0, 0, 0], [-2, -2, -2]]))
    )[0]
    assert unpack_keys(coarsen(keys)[0])[1].tolist() == [[-1, -1, -1], [0, 0, 0]]


def test_batches_do_not_touch() -> None:
    coordinates = torch.zeros(2, 3, dtype=torch.long)
    kernel_map = neighbour_map(pack_keys(torch.tensor([0, 1]), coordinates))
    assert torch.equal(kernel_map.inputs, kernel_map.outputs)


def test_extreme_neighbours_do_not_wrap_into_another_row() -> None:
    ends = torch.tensor([[0, 0, -(10**9)], [0, -1, 10**9]])
    keys = unique_voxels(pack_keys(torch.zeros(2, dtype=torch.long), ends))[0]
    kernel_map = neighbour_map(keys)
    assert torch.equal(kernel_map.inputs, kernel_map.outputs)


def test_centre_offset_is_the_identity() -> None:
    keys = pack_keys(torch.zeros(4, dtype=torch.long), torch.arange(12).reshape(4, 3))
    weight = torch.zeros(27, 2, 2)
    weight[OFFSETS.index((0, 0, 0))] = torch.eye(2)
    f = torch.randn(4, 2)
    assert torch.equal(sparse_conv(f, weight, neighbour_map(keys)), f)


def test_wrong_shapes_are_named() -> None:
    keys = pack_keys(torch.zeros(4, dtype=torch.long), torch.arange(12).reshape(4, 3))
    with pytest.raises(ValueError, match=r"got \[3, 2\] and \[27, 2, 2\]"):
        sparse_conv(torch.zeros(3, 2), torch.zeros(27, 2, 2), neighbour_map(keys))


@pytest.mark.parametrize("points", [0, 1, 50], ids=["empty", "single voxel", "all in one voxel"])
def test_unet_on_degenerate_inputs(points: int) -> None:
    torch.manual_seed(0)
    pyramid = VoxelPyramid.from_keys(
        pack_keys(torch.zeros(points, dtype=torch.long), torch.zeros(points, 3, dtype=torch.long)), 3
    )
    unet = SparseUNet(6, (4, 6, 8))
    features = torch.randn(points, 6)
    mean, counts = pyramid.pool(features, torch.arange(points))
    out = unet(mean, pyramid)
    assert out.shape == (min(points, 1), 4)
    assert bool(torch.isfinite(out).all())
    torch.testing.assert_close(mean, features.mean(0, keepdim=True)[: min(points, 1)])
    assert counts.flatten().tolist() == [points] * min(points, 1)


def test_a_voxel_s_mean_is_over_the_given_points_and_zero_without_any() -> None:
    pyramid = VoxelPyramid.from_keys(
        pack_keys(torch.zeros(4, dtype=torch.long), torch.tensor([[0, 0, 0]] * 3 + [[5, 0, 0]])), 1
    )
    points = torch.tensor([0, 2])
    mean, counts = pyramid.pool(torch.tensor([[1.0], [4.0]]), points)
    own, other = (int(pyramid.voxel_of[i]) for i in (0, 3))
    assert mean[own].item() == 2.5
    assert mean[other].item() == 0
    assert (counts[own].item(), counts[other].item()) == (2, 1)


def test_unet_follows_a_permutation_of_the_points() -> None:
    torch.manual_seed(0)
    coordinates = torch.randint(-8, 8, (300, 3))
    features, unet = torch.randn(300, 6), SparseUNet(6, (4, 6, 8))
    order = torch.randperm(300)

    def per_point(c: torch.Tensor, f: torch.Tensor) -> torch.Tensor:
        pyramid = VoxelPyramid.from_keys(pack_keys(torch.zeros(len(c), dtype=torch.long), c), 3)
        return unet(pyramid.pool(f, torch.arange(len(f)))[0], pyramid)[pyramid.voxel_of]

    torch.testing.assert_close(
        per_point(coordinates, features)[order], per_point(coordinates[order], features[order]), atol=1e-5, rtol=1e-5
    )


def test_unet_is_unmoved_by_a_shift_of_whole_coarse_voxels() -> None:
    torch.manual_seed(0)
    coordinates = torch.randint(-8, 8, (300, 3))
    features, unet = torch.randn(300, 6), SparseUNet(6, (4, 6, 8))
    results = []
    for shift in (0, 4, -12):
        pyramid = VoxelPyramid.from_keys(pack_keys(torch.zeros(300, dtype=torch.long), coordinates + shift), 3)
        results.append(unet(pyramid.pool(features, torch.arange(300))[0], pyramid)[pyramid.voxel_of])
    torch.testing.assert_close(results[1], results[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(results[2], results[0], atol=1e-5, rtol=1e-5)
