"""Clouds and streets of Gaussians with cameras, and the one backward pass that all gradient tests use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from genre_tasks.render import Cameras, Render, RenderSettings, render
from genre_tasks.scene.gaussians import Splats
from tests.render.oracles import reference_bands, relative_l2

NAMES = ("means", "scales", "quats", "opacities", "colors")
Scene = tuple[Splats, Cameras]


def cloud(n: int, width: int = 64, height: int = 48, views: int = 1, seed: int = 0) -> Scene:
    """n Gaussians of about a neighbour's distance in size, 2 to 60 m ahead; cameras half a metre apart."""
    g = torch.Generator().manual_seed(seed)
    z = 2 + 58 * torch.rand(n, generator=g) ** 1.5
    xy = (torch.rand(n, 2, generator=g) * 2 - 1) * torch.stack([0.9 * z, 0.5 * z], 1)
    size = 2.5 * z / max(n, 1) ** 0.5
    splats = Splats(
        torch.cat([xy, z[:, None]], 1),
        size[:, None] * torch.exp(0.5 * torch.randn(n, 3, generator=g)),
        torch.randn(n, 4, generator=g),
        0.05 + 0.9 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g),
    )
    return splats, turned_cameras(width, height, 0.7 * width, views, (1.5, -0.7))


def street(n: int, width: int, height: int, seed: int = 7) -> Scene:
    """A road, facades with relief, boxes on the road and a far shell, sized by their neighbours as 3DGS starts."""
    r = np.random.default_rng(seed)
    ground_count, shell_count = int(0.3 * n), int(0.12 * n)
    facade_count = n - ground_count - shell_count
    z = 2 + 58 * r.random(ground_count) ** 1.5
    ground = np.stack([(r.random(ground_count) * 2 - 1) * 9, 1.6 + 0.02 * r.standard_normal(ground_count), z], 1)
    z = 2 + 58 * r.random(facade_count) ** 1.4
    side, y = np.where(r.random(facade_count) < 0.5, -1, 1), 1.6 - 14 * r.random(facade_count)
    relief = 0.35 * np.round(np.sin(z * 1.7) * np.cos(y * 1.9))
    facade = np.stack([side * (9 + relief + 0.03 * r.standard_normal(facade_count)), y, z], 1)
    boxes = facade_count // 6
    which = r.integers(0, 12, boxes)
    box_x, box_z = np.where(which % 2 == 0, -4.5, 4.2), np.linspace(6, 50, 12)[which]
    offset = r.random((boxes, 3)) - [0.5, 0.0, 0.5]
    facade[:boxes] = np.stack([box_x, np.full(boxes, 1.6), box_z], 1) + offset * [1.8, -1.5, 4.0]
    shell = r.standard_normal((shell_count, 3)) * [1, 0.8, 1]
    shell[:, 1], shell[:, 2] = -np.abs(shell[:, 1]), np.abs(shell[:, 2]) + 0.2
    shell *= 150 / np.linalg.norm(shell, axis=1, keepdims=True) * (1 + 0.05 * r.standard_normal((shell_count, 1)))
    means = r.permutation(np.concatenate([ground, facade, shell]))
    spacing = np.sqrt(np.square(cKDTree(means).query(means, k=4)[0][:, 1:]).mean(1))
    parts = (
        means,
        np.clip(spacing[:, None] * np.exp(0.35 * r.standard_normal((n, 3))), 1e-3, 20),
        r.standard_normal((n, 4)),
        0.1 + 0.85 * r.random(n),
        r.random((n, 3)),
    )
    focal = 0.5 * width / np.tan(np.radians(35))
    return Splats(*(torch.from_numpy(p).float() for p in parts)), turned_cameras(width, height, focal)


def turned_cameras(
    width: int, height: int, focal: float, views: int = 1, offset: tuple[float, float] = (0.0, 0.0)
) -> Cameras:
    """Half a metre apart, turned by 0.12 rad, so that no coordinate stays as it is."""
    poses = torch.eye(4).repeat(views, 1, 1)
    poses[:, 0, 3] = 0.5 * torch.arange(views)
    turn = torch.tensor(0.12)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = turn.cos(), turn.sin(), -turn.sin(), turn.cos()
    center = torch.tensor([[width / 2 + offset[0], height / 2 + offset[1]]]).repeat(views, 1)
    return Cameras(poses, torch.full((views, 2), focal), center, width, height)


def gradients(
    splats: Splats,
    cameras: Cameras,
    settings: RenderSettings,
    dtype: torch.dtype = torch.float32,
    mask: Tensor | None = None,
    bands: tuple[int, ...] | None = None,
) -> tuple[Render, dict[str, Tensor]]:
    """The render, and the gradients of a fixed random weighting of colour, alpha and depth.

    Pixels where ``mask`` [V, H, W] is false have no weight. With ``bands`` only these are rendered, by the reference.
    """
    leaves = {n: getattr(splats, n).detach().to(dtype).clone().requires_grad_() for n in NAMES}
    moved = replace(splats.to(dtype), **leaves)
    out = render(moved, cameras, settings) if bands is None else reference_bands(moved, cameras, bands)
    g = torch.Generator().manual_seed(1)
    shape = (len(cameras), cameras.height_px, cameras.width_px)
    kept = torch.ones(shape) if mask is None else mask.float()
    weights = (
        torch.randn(*shape, 3, generator=g) * kept[..., None],
        torch.randn(shape, generator=g) * kept,
        torch.randn(shape, generator=g) / 20 * kept,
    )
    images = (out.color, out.alpha, out.depth)
    torch.autograd.backward(images, [w.to(i) for w, i in zip(weights, images, strict=True)])
    return out, {n: leaf.grad for n, leaf in leaves.items() if leaf.grad is not None}


def smooth() -> tuple[Splats, Cameras]:
    """Gaussians that fill the image without reaching the cut or the clamp, so that finite differences are valid."""
    g = torch.Generator().manual_seed(5)
    means = torch.randn(5, 3, generator=g, dtype=torch.float64) * 0.3 + torch.tensor([0.1, -0.1, 4.0])
    scales = 1.5 + torch.rand(5, 3, generator=g, dtype=torch.float64)
    quats, colors = torch.randn(5, 4, generator=g).double(), torch.rand(5, 3, generator=g).double()
    splats = Splats(means, scales, quats, torch.full((5,), 0.5, dtype=torch.float64), colors)
    pose = torch.linalg.matrix_exp(twist(torch.tensor([0.2, -0.1, 0.15, 0.1, 0.2, -0.3], dtype=torch.float64)))
    return splats, Cameras(pose[None], torch.tensor([[20.0, 22.0]]), torch.tensor([[12.5, 7.5]]), 24, 16)


def twist(v: Tensor) -> Tensor:
    """[4, 4] the generator of a rigid motion: three of rotation, three of translation."""
    zero = v.new_zeros(())
    rows = [[zero, -v[2], v[1], v[3]], [v[2], zero, -v[0], v[4]], [-v[1], v[0], zero, v[5]], [zero] * 4]
    return torch.stack([torch.stack(r) for r in rows])


def moved_loss(splats: Splats, cameras: Cameras, xi: Tensor, settings: RenderSettings) -> Tensor:
    """Of the images, with the first camera moved by ``xi`` [6]."""
    pose = torch.linalg.matrix_exp(twist(xi)) @ cameras.camera_SE3_chunk[0].to(xi.dtype)
    out = render(splats.to(xi.dtype), replace(cameras, camera_SE3_chunk=pose[None]), settings)
    return (out.color.square().sum() + (out.alpha - 0.3).square().sum() + 0.1 * out.depth.sum()).double()


def pose_gradient_error(splats: Splats, cameras: Cameras, settings: RenderSettings, dtype: torch.dtype) -> float:
    """Relative distance of the gradient of :func:`moved_loss` in ``xi`` from the float64 finite difference."""
    xi = torch.zeros(6, dtype=dtype, requires_grad=True)
    moved_loss(splats, cameras, xi, settings).backward()
    assert xi.grad is not None
    expected, reference = torch.zeros(6, dtype=torch.float64), RenderSettings("reference")
    with torch.no_grad():
        for k, e in enumerate(1e-5 * torch.eye(6, dtype=torch.float64)):
            ahead, back = (moved_loss(splats, cameras, s * e, reference) for s in (1, -1))
            expected[k] = (ahead - back) / 2e-5
    return relative_l2(xi.grad, expected)
