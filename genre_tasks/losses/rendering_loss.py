"""The rendering loss (paper Eq. 9–11) over a batch of views, and its gradient at the rendered images.

Each view's loss is taken on its own, on one thread, so that the sums have one order at any thread count; views are
spread over the threads. The perceptual distance costs far more than the other terms together: it is taken in every
``perceptual_every``-th iteration, on one random crop of at most ``CROP_PX`` of ``perceptual_views`` source and as many
novel views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.constants import DEPTH_LOSS_MAX, DEPTH_MIN_M
from genre_tasks.losses.image_loss import ImageLoss, image_loss, takes
from genre_tasks.losses.ssim import ssim
from genre_tasks.losses.targets import Target
from genre_tasks.threads import map_single_threaded

CROP_PX = 128
"""Side of the perceptual term's crop: the network's stride is 32, its features see about a hundred pixels."""

Distance = Callable[[Tensor, Tensor], Tensor]
"""[B, H, W, 3] twice → [B]."""

Crop = tuple[int, int, int, int]
"""Row, column, height, width in pixels."""


@dataclass(frozen=True)
class LossPlan:
    """What is taken of each view of a batch: its weight, and the crop for the perceptual term where it is taken."""

    weights: tuple[float, ...]
    crops: tuple[Crop | None, ...]


def plan_loss(
    config: LossConfig, targets: Sequence[Target], iteration: int, generator: torch.Generator, perceptual: bool = True
) -> LossPlan:
    """Weights and crops of a batch: the mean over source views plus λ_novel times the mean over novel views.

    A crop's term counts for its one view as if it were the whole image's: with λ_lpips times that view's weight.
    """
    novel = sum(t.novel for t in targets)
    source = len(targets) - novel
    weights = tuple(config.novel / novel if t.novel else 1.0 / source for t in targets)
    crops: list[Crop | None] = [None] * len(targets)
    if perceptual and config.perceptual > 0 and iteration % config.perceptual_every == 0:
        for kind in (False, True):
            of_kind = [i for i, t in enumerate(targets) if t.novel == kind]
            for _ in range(min(config.perceptual_views, len(of_kind))):
                i = of_kind.pop(_below(len(of_kind), generator))
                crops[i] = _crop(targets[i].image.image.shape, generator)
    return LossPlan(weights, tuple(crops))


def view_loss(
    config: LossConfig,
    color: Tensor,  # [H, W, 3]
    depth: Tensor,  # [H, W] metres, 0 where nothing was rendered
    target: Target,
) -> Tensor:
    """The weighted sum of one view's terms except for the perceptual one, a scalar.

    Finite for any finite input, also without LiDAR returns.
    """
    image = target.image.image
    loss = config.rgb * (color - image).abs().mean()
    if config.ssim > 0:
        loss = loss + config.ssim * (1.0 - ssim(color, target.image))
    if config.depth > 0 and target.depth is not None:
        loss = loss + config.depth * depth_loss(depth, target.depth)
    return loss


def depth_loss(depth: Tensor, target: Tensor) -> Tensor:
    """Mean of |1/d − 1/d̂|·d̂ = |d̂/d − 1|, clamped at 1, over the pixels with a LiDAR return and a rendered surface.

    Relative and in inverse depth: near and far returns count alike, and a surface missing altogether cannot outweigh
    the rest. [H, W] metres twice → scalar; 0 (with no gradient) where no pixel has both.
    """
    valid = torch.isfinite(target) & (target > 0) & (depth > 0)
    if not bool(valid.any()):
        return depth.new_zeros(())
    return (target[valid] / depth[valid].clamp_min(DEPTH_MIN_M) - 1.0).abs().clamp_max(DEPTH_LOSS_MAX).mean()


def image_gradients(
    config: LossConfig,
    color: Tensor,  # [V, H, W, 3]
    depth: Tensor,  # [V, H, W]
    targets: Sequence[Target],
    plan: LossPlan,
    distance: Distance | None = None,
) -> tuple[float, Tensor, Tensor]:
    """The batch's loss and its gradients with respect to ``color`` and ``depth``.

    In float32 on the CPU all but the perceptual term is the compiled kernel's work; elsewhere it is torch's. A target
    with a gain is compared with the render at that gain; where the vehicle itself is in its image nothing pulls.
    """
    gains = _gains(targets, color)
    if gains is not None:
        from genre_tasks.effects.exposure import slope, toned

        color = toned(color, gains)
    take = image_loss if takes(color, depth, targets) else torch_image_loss
    sums = take(config, color, depth, targets, plan.weights)
    loss = float(sums.losses.sum())
    if distance is not None:
        loss += _add_perceptual(config, color, targets, plan, distance, sums.by_color)
    for i, target in enumerate(targets):
        if target.own is not None:
            sums.by_color[i][target.own], sums.by_depth[i][target.own] = 0.0, 0.0
    return loss, sums.by_color if gains is None else sums.by_color * slope(gains), sums.by_depth


def residual_image(color: Tensor, targets: Sequence[Target]) -> Tensor:
    """What each image has beyond the render, in the scene's own colours, [V, H, W, 3]; 0 on the vehicle itself."""
    gains = _gains(targets, color)
    shown = color
    if gains is not None:
        from genre_tasks.effects.exposure import slope, toned

        shown = toned(color, gains)
    out = torch.empty_like(color)
    for i, target in enumerate(targets):
        _subtract(target.image.image, shown[i], out[i])
        if target.own is not None:
            out[i][target.own] = 0.0
    return out if gains is None else out / slope(gains)


def _subtract(a: Tensor, b: Tensor, out: Tensor) -> None:
    """On the CPU by numpy: torch would wake its threads, which then spin beside the kernels'."""
    if out.device.type == "cpu":
        np.subtract(a.numpy(), b.numpy(), out=out.numpy())
    else:
        torch.sub(a, b, out=out)


def _gains(targets: Sequence[Target], like: Tensor) -> Tensor | None:
    """[V, 1, 1, 3] log gains, ``None`` where no target has one."""
    if all(t.log_gain is None for t in targets):
        return None
    return like.new_tensor([t.log_gain or (0.0, 0.0, 0.0) for t in targets])[:, None, None]


def torch_image_loss(
    config: LossConfig, color: Tensor, depth: Tensor, targets: Sequence[Target], weights: Sequence[float]
) -> ImageLoss:
    """As :func:`genre_tasks.losses.image_loss.image_loss`, from :func:`view_loss`: for any device and precision."""

    def one(i: int) -> tuple[Tensor, Tensor, Tensor]:
        c, d = color[i].detach().requires_grad_(), depth[i].detach().requires_grad_()
        with torch.enable_grad():
            loss = weights[i] * view_loss(config, c, d, targets[i])
        by_color, by_depth = torch.autograd.grad(loss, (c, d), allow_unused=True)
        return loss.detach().double(), by_color, torch.zeros_like(d) if by_depth is None else by_depth

    parts = map_single_threaded(one, range(len(targets)))
    return ImageLoss(*(torch.stack(column) for column in zip(*parts, strict=True)))


def _add_perceptual(
    config: LossConfig, color: Tensor, targets: Sequence[Target], plan: LossPlan, distance: Distance, by_color: Tensor
) -> float:
    """The perceptual term of the views that have a crop; adds its gradient to ``by_color`` in place."""

    def one(view_crop: tuple[int, Crop]) -> float:
        i, (row, column, height, width) = view_crop
        window = slice(row, row + height), slice(column, column + width)
        rendered = color[i][window].detach().requires_grad_()
        with torch.enable_grad():
            value = distance(rendered[None].clamp(0, 1), targets[i].image.image[window][None])[0]
            loss = plan.weights[i] * config.perceptual * value
        by_color[i][window] += torch.autograd.grad(loss, rendered)[0]
        return float(loss.detach())

    return sum(map_single_threaded(one, [(i, crop) for i, crop in enumerate(plan.crops) if crop is not None]))


def _below(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _crop(shape: torch.Size, generator: torch.Generator) -> Crop:
    height, width = min(CROP_PX, shape[0]), min(CROP_PX, shape[1])
    return _below(shape[0] - height + 1, generator), _below(shape[1] - width + 1, generator), height, width
