"""The rendering loss (paper Eq. 9–11) over a batch of views, and its gradient at the rendered images.

Each view's loss is taken on its own, on one thread, so that the sums have one order at any thread count; views are
spread over the threads. The perceptual distance costs about ten times as much as the other terms together: it is taken
in every ``perceptual_every``-th iteration, on one random crop of at most ``CROP_PX`` of one source view and one novel
view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.metrics.threads import map_single_threaded
from genre_tasks.optimiser.ssim import ssim
from genre_tasks.optimiser.targets import Target

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

    The crop's term counts for its one view as if it were the whole image's: with λ_lpips times that view's weight.
    """
    novel = sum(t.novel for t in targets)
    source = len(targets) - novel
    weights = tuple(config.novel / novel if t.novel else 1.0 / source for t in targets)
    crops: list[Crop | None] = [None] * len(targets)
    if perceptual and config.perceptual > 0 and iteration % config.perceptual_every == 0:
        for kind in (False, True):
            of_kind = [i for i, t in enumerate(targets) if t.novel == kind]
            if of_kind:
                i = of_kind[_below(len(of_kind), generator)]
                crops[i] = _crop(targets[i].image.image.shape, generator)
    return LossPlan(weights, tuple(crops))


def view_loss(
    config: LossConfig,
    color: Tensor,  # [H, W, 3]
    depth: Tensor,  # [H, W] metres, 0 where nothing was rendered
    target: Target,
    crop: Crop | None = None,
    distance: Distance | None = None,
) -> Tensor:
    """The weighted sum of one view's terms, a scalar; finite for any finite input, also without LiDAR returns."""
    image = target.image.image
    loss = config.rgb * (color - image).abs().mean()
    if config.ssim > 0:
        loss = loss + config.ssim * (1.0 - ssim(color, target.image))
    if config.depth > 0 and target.depth is not None:
        loss = loss + config.depth * depth_loss(depth, target.depth)
    if crop is not None and distance is not None:
        row, column, height, width = crop
        window = slice(row, row + height), slice(column, column + width)
        value = distance(color[window][None].clamp(0, 1), image[window][None])[0]
        loss = loss + config.perceptual * value
    return loss


def depth_loss(depth: Tensor, target: Tensor) -> Tensor:
    """Mean of |1/d − 1/d̂|·d̂ = |d̂/d − 1|, clamped at 1, over the pixels with a LiDAR return and a rendered surface.

    Relative and in inverse depth: near and far returns count alike, and a surface missing altogether cannot outweigh
    the rest. [H, W] metres twice → scalar; 0 (with no gradient) where no pixel has both.
    """
    valid = torch.isfinite(target) & (target > 0) & (depth > 0)
    if not bool(valid.any()):
        return depth.new_zeros(())
    return (target[valid] / depth[valid].clamp_min(1e-3) - 1.0).abs().clamp_max(1.0).mean()


def image_gradients(
    config: LossConfig,
    color: Tensor,  # [V, H, W, 3]
    depth: Tensor,  # [V, H, W]
    targets: Sequence[Target],
    plan: LossPlan,
    distance: Distance | None = None,
) -> tuple[float, Tensor, Tensor]:
    """The batch's loss and its gradients with respect to ``color`` and ``depth``."""

    def one(i: int) -> tuple[Tensor, Tensor, Tensor]:
        c, d = color[i].detach().requires_grad_(), depth[i].detach().requires_grad_()
        with torch.enable_grad():
            loss = plan.weights[i] * view_loss(config, c, d, targets[i], plan.crops[i], distance)
        by_color, by_depth = torch.autograd.grad(loss, (c, d), allow_unused=True)
        return loss.detach(), by_color, torch.zeros_like(d) if by_depth is None else by_depth

    parts = map_single_threaded(one, range(len(targets)))
    losses, by_color, by_depth = zip(*parts, strict=True)
    return float(torch.stack(losses).double().sum()), torch.stack(by_color), torch.stack(by_depth)


def _below(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _crop(shape: torch.Size, generator: torch.Generator) -> Crop:
    height, width = min(CROP_PX, shape[0]), min(CROP_PX, shape[1])
    return _below(shape[0] - height + 1, generator), _below(shape[1] - width + 1, generator), height, width
