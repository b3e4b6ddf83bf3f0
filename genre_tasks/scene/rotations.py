"""Rotations as quaternions (w, x, y, z) and as matrices, each conversion in one place."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Converts quaternions to rotation matrices, differentiably.

    The gradient goes through the normalisation: it is (v − (v·q̂)q̂) / ‖q‖, so a quaternion's length gets none.

    Args:
        quats: [N, 4], w first; any length but zero.

    Returns:
        Rotation matrices [N, 3, 3].

    >>> quats_to_matrices(torch.tensor([[2.0, 0.0, 0.0, 0.0]]))[0].tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    # Dividing by the largest entry first keeps the squares of long quaternions finite and changes no direction.
    quats = quats / quats.detach().abs().amax(1, keepdim=True)
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, 1)


def quats_to_matrices_numpy(quats: Float64) -> Float64:
    """Converts quaternions to rotation matrices in float64, for set-up work that needs no gradient.

    Args:
        quats: [..., 4], w first; any length but zero.

    Returns:
        Rotation matrices [..., 3, 3].

    >>> quats_to_matrices_numpy(np.array([0.0, 0.0, 0.0, 1.0])).tolist()  # half a turn about z
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    # Not scipy's Rotation: its diagonal is w² + x² − y² − z², which rounds differently, and scenes would change.
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrices_to_quats(rotation: Tensor) -> Tensor:
    """Converts rotation matrices to unit quaternions; exact also for half turns.

    Args:
        rotation: [..., 3, 3].

    Returns:
        Quaternions [..., 4], w first.

    >>> matrices_to_quats(torch.eye(3)).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    # Not by the trace alone: its formula divides by w, which is zero for half turns.
    return rotation_matrix_to_quaternion(rotation.contiguous())


def multiply_quats(a: Tensor, b: Tensor) -> Tensor:
    """Composes rotations: the Hamilton product a ∘ b, which turns by b first.

    Args:
        a: [..., 4], w first.
        b: [..., 4], w first.

    Returns:
        [..., 4]; norms multiply.

    >>> quarter_turn = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
    >>> multiply_quats(quarter_turn, quarter_turn).abs().round(decimals=6).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def rotate_vectors(quats: Tensor, vectors: Tensor) -> Tensor:
    """Turns vectors by quaternions, without forming matrices.

    Args:
        quats: [N, 4], w first; a zero quaternion leaves its vector as it is.
        vectors: [N, 3].

    Returns:
        The turned vectors [N, 3].

    >>> rotate_vectors(torch.tensor([[0.0, 0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])).tolist()
    [[-1.0, 0.0, 0.0]]
    """
    # The floor keeps a zero quaternion from becoming NaN.
    unit = quats / quats.norm(dim=1, keepdim=True).clamp_min(1e-20)
    w = unit[:, :1]
    axis = unit[:, 1:]
    # Two cross products cost less than a matrix for each vector.
    doubled = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * doubled + torch.linalg.cross(axis, doubled)
