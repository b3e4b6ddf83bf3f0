"""A street-like cloud and cameras along it, and the one backward pass that all gradient tests use."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from genre_tasks.render import Cameras, Render, RenderSettings, render
from genre_tasks.scene.gaussians import Splats

NAMES = ("means", "scales", "quats", "opacities", "colors")
Scene = tuple[Splats, Cameras]


def _scene(n: int, width: int = 64, height: int = 48, views: int = 1, seed: int = 0) -> Scene:
    """n Gaussians of about a neighbour's distance in size, 2 to 60 m ahead; cameras half a metre apart."""
    g = torch.Generator().manual_seed(seed)
    z = 2 + 58 * torch.rand(n, generator=g) ** 1.5
    xy = (torch.rand(n, 2, generator=g) * 2 - 1) * torch.stack([0.9 * z, 0.5 * z], 1)
    size = 2.5 * z / max(n, 1) ** 0.5
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = 0.5 * torch.arange(views)
    turn = torch.tensor(0.12)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = turn.cos(), turn.sin(), -turn.sin(), turn.cos()
    focal = 0.7 * width
    splats = Splats(
        torch.cat([xy, z[:, None]], 1),
        size[:, None] * torch.exp(0.5 * torch.randn(n, 3, generator=g)),
        torch.randn(n, 4, generator=g),
        0.05 + 0.9 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g),
    )
    center = torch.tensor([[width / 2 + 1.5, height / 2 - 0.7]])
    return splats, Cameras(poses, torch.full((views, 2), focal), center.repeat(views, 1), width, height)


def _gradients(
    splats: Splats, cameras: Cameras, settings: RenderSettings, dtype: torch.dtype = torch.float32
) -> tuple[Render, dict[str, Tensor]]:
    """The render, and the gradients of a fixed random weighting of colour, alpha and depth."""
    leaves = {n: getattr(splats, n).detach().to(dtype).clone().requires_grad_() for n in NAMES}
    out = render(Splats(**leaves), cameras, settings)
    g = torch.Generator().manual_seed(1)
    shape = (len(cameras), cameras.height_px, cameras.width_px)
    weights = (
        torch.randn(*shape, 3, generator=g),
        torch.randn(shape, generator=g),
        torch.randn(shape, generator=g) / 20,
    )
    torch.autograd.backward((out.color, out.alpha, out.depth), [w.to(dtype) for w in weights])
    return out, {n: leaf.grad for n, leaf in leaves.items() if leaf.grad is not None}


@pytest.fixture(scope="session")
def scene() -> Callable[..., Scene]:
    return _scene


@pytest.fixture(scope="session")
def gradients() -> Callable[..., tuple[Render, dict[str, Tensor]]]:
    return _gradients
