"""Street-like clouds of Gaussians with a fixed seed, and cameras in them: what the renderer is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.render import Cameras, Render, RenderSettings, render
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.initial_gaussians import measure_neighbour_spacing

SEED = 7
FIELD_OF_VIEW_DEG = 70.0
YAW_RAD = 0.12
CAMERA_HEIGHT_M = 1.6
ROAD_HALF_WIDTH_M = 9.0
ATTRIBUTES = ("means", "scales", "quats", "opacities", "colors")


@dataclass(frozen=True)
class Case:
    """A size of a scene.

    Attributes:
        name: in the names of cells.
        count: Gaussians.
        height_px: of the image.
        width_px: of the image.
    """

    name: str
    count: int
    height_px: int
    width_px: int


CASES = (Case("20k", 20_000, 160, 240), Case("100k", 100_000, 320, 480), Case("300k", 300_000, 540, 960))
MANY = Case("many views", 20_000, 180, 320)


@dataclass(frozen=True)
class Scene:
    """What is rendered, and the weights of the images whose sum is differentiated."""

    splats: Splats
    cameras: Cameras
    v_color: Tensor  # [V, H, W, 3]
    v_alpha: Tensor  # [V, H, W]
    v_depth: Tensor  # [V, H, W]


def scene(case: Case, views: int = 1, device: str = "cpu") -> Scene:
    """Makes a case's scene; the cameras look down the street, each half a metre ahead of the one before.

    Args:
        case: size of the scene.
        views: cameras.
        device: of the tensors.

    Returns:
        Scene: the same for the same arguments.
    """
    # The focal length follows from the width, so all sizes see the same part of the street.
    focal = 0.5 * case.width_px / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
    pose = torch.eye(4).repeat(views, 1, 1)
    sin = np.sin(YAW_RAD)
    cos = np.cos(YAW_RAD)
    pose[:, 0, 0] = cos
    pose[:, 0, 2] = sin
    pose[:, 2, 0] = -sin
    pose[:, 2, 2] = cos
    # Each camera half a metre ahead, so that views differ as those of a drive do.
    ahead = torch.stack([torch.zeros(views), torch.zeros(views), 0.5 * torch.arange(views)], 1)
    pose[:, :3, 3] = -(pose[:, :3, :3] @ ahead[:, :, None])[:, :, 0]
    center = torch.tensor([[case.width_px / 2, case.height_px / 2]]).repeat(views, 1)
    cameras = Cameras(pose, torch.full((views, 2), float(focal)), center, case.width_px, case.height_px)
    g = torch.Generator().manual_seed(1)
    shape = (views, case.height_px, case.width_px)
    # Random weights of the images make every path of the backward pass count.
    v_color = torch.randn(*shape, 3, generator=g)
    v_alpha = torch.randn(shape, generator=g)
    v_depth = 0.05 * torch.randn(shape, generator=g)
    return Scene(street(case.count).to(device), cameras, v_color.to(device), v_alpha.to(device), v_depth.to(device))


def street(count: int, seed: int = SEED) -> Splats:
    """Makes a street around a camera at the origin (y down, z ahead): ground, façades, cars and a distant shell.

    Args:
        count: Gaussians.
        seed: of all random numbers.

    Returns:
        Splats: in random order, as no scene is sorted.
    """
    r = np.random.default_rng(seed)
    n_ground = int(count * 0.30)
    n_shell = int(count * 0.12)
    parts = (_ground(r, n_ground), _facades(r, count - n_ground - n_shell), _shell(r, n_shell))
    # Kinds are shuffled: memory access must not profit from an order that no scene has.
    order = r.permutation(count)
    means = np.concatenate(parts)[order]
    kind = np.repeat([0, 1, 2], [len(p) for p in parts])[order]
    # As 3DGS starts: about as large as the distance to the nearest three, here with some spread of shapes.
    scales = (measure_neighbour_spacing(means, 1.0)[:, None] * np.exp(0.35 * r.standard_normal((count, 3)))).clip(
        1e-3, 20
    )
    # Normalised normal deviates are uniform over all rotations.
    quats = r.standard_normal((count, 4))
    x, y, z = means.T
    waves = np.stack([np.sin(0.9 * z + kind), np.cos(0.7 * y), np.sin(0.4 * x + 2 * kind)], 1)
    colors = (0.5 + 0.35 * waves + 0.1 * r.standard_normal((count, 3))).clip(0, 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    arrays = (means, scales, quats, 0.1 + 0.85 * r.random(count), colors)
    return Splats(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays))


def _ground(r: np.random.Generator, n: int) -> Float64:
    """A plane under the camera whose density falls with distance, as LiDAR's does."""
    z = 2 + 58 * r.random(n) ** 1.5
    x = (2 * r.random(n) - 1) * ROAD_HALF_WIDTH_M
    return np.stack([x, CAMERA_HEIGHT_M + 0.02 * r.standard_normal(n), z], 1)


def _facades(r: np.random.Generator, n: int) -> Float64:
    """Both sides of the street, 14 m high with relief; every sixth point is on one of twelve cars instead."""
    z = 2 + 58 * r.random(n) ** 1.4
    y = CAMERA_HEIGHT_M - 14 * r.random(n)
    relief = 0.35 * np.round(np.sin(1.7 * z) * np.cos(1.9 * y)) + 0.03 * r.standard_normal(n)
    points = np.stack([r.choice([-1, 1], n) * (ROAD_HALF_WIDTH_M + relief), y, z], 1)
    # Cars in front of the façades give depth edges and occlusion.
    k = n // 6
    car = r.integers(0, 12, k)
    x = np.where(car % 2 == 0, -4.5, 4.2) + 1.8 * (r.random(k) - 0.5)
    z = np.linspace(6, 50, 12)[car] + 4 * (r.random(k) - 0.5)
    points[:k] = np.stack([x, CAMERA_HEIGHT_M - 1.5 * r.random(k), z], 1)
    return points


def _shell(r: np.random.Generator, n: int) -> Float64:
    """Sky and distance: the half ahead of a sphere of some 150 m."""
    d = r.standard_normal((n, 3))
    # The y axis points down, so the sky is at negative values.
    d[:, 1] = -0.8 * np.abs(d[:, 1])
    d[:, 2] = np.abs(d[:, 2]) + 0.2
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return d * 150 * (1 + 0.05 * r.standard_normal((n, 1)))


def gradient_leaves(splats: Splats) -> Splats:
    """Copies splats to leaves that want a gradient in all 14 attributes.

    Args:
        splats: to copy.

    Returns:
        Splats: on the same device.
    """
    # Cloned, because the scene's own tensors serve renders without gradients too.
    return Splats(*(getattr(splats, name).detach().clone().requires_grad_() for name in ATTRIBUTES))


def forward(s: Scene, threads: int | None) -> Render:
    """Renders without keeping anything for a backward pass.

    Args:
        s: to render.
        threads: of the renderer; ``None``: its default.

    Returns:
        Render: colour, alpha and depth.
    """
    with torch.no_grad():
        return render(s.splats, s.cameras, RenderSettings(threads=threads))


def forward_backward(s: Scene, leaves: Splats, threads: int | None) -> None:
    """Renders, and leaves fresh gradients of all 14 attributes in ``leaves``.

    Args:
        s: with the cameras and the weights of the images.
        leaves: to render; their gradients are replaced.
        threads: of the renderer; ``None``: its default.
    """
    # Gradients would add up over the rounds, and the addition would be timed too.
    for name in ATTRIBUTES:
        getattr(leaves, name).grad = None
    out = render(leaves, s.cameras, RenderSettings(threads=threads))
    torch.autograd.backward((out.color, out.alpha, out.depth), (s.v_color, s.v_alpha, s.v_depth))
