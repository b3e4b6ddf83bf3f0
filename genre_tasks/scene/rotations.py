"""Rotation matrices from quaternions, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 4], need not be unit → [N, 3, 3]; autograd through the normalisation gives (v − (v·q̂)q̂) / ‖q‖."""
    # Dividing by the largest entry first keeps the squares of long quaternions finite and changes no direction.
    quats = quats / quats.detach().abs().amax(1, keepdim=True)
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, 1)
