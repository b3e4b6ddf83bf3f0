"""The rendering loss (paper Eq. 9–11) over a batch of views, and its gradient at the rendered images.

Each view's loss is computed on one thread, so that its sums have one order at any number of threads; several views are
computed at once. The perceptual distance costs far more than the other terms together. It is therefore computed in
every ``perceptual_every``-th iteration alone, on one random crop of at most ``CROP_PX`` in each of
``perceptual_views`` source views and as many novel views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.constants import DEPTH_LOSS_MAX, DEPTH_MIN_M
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.image_loss import ImageLoss, image_loss, is_supported
from genre_tasks.losses.ssim import ssim
from genre_tasks.losses.targets import Target
from genre_tasks.threads import map_single_threaded

CROP_PX = 128
"""Side of the perceptual term's crop: the network's stride is 32, its features see about a hundred pixels."""

ImageDistance = Callable[[Tensor, Tensor], Tensor]
"""A perceptual distance: two batches of images [B, H, W, 3] in [0, 1] → [B]."""

Crop = tuple[int, int, int, int]
"""Row, column, height, width in pixels."""


@dataclass(frozen=True)
class LossTerms:
    """Which terms of the loss each view of a batch has, and how much they count.

    Attributes:
        weights: V weights, one for each view.
        crops: V crops for the perceptual term; ``None`` where a view is without it.
    """

    weights: tuple[float, ...]
    crops: tuple[Crop | None, ...]


def select_loss_terms(
    config: LossConfig, targets: Sequence[Target], iteration: int, generator: torch.Generator, perceptual: bool = True
) -> LossTerms:
    """Chooses the weights of a batch's views, and which of them get the perceptual term.

    The loss is the mean over source views plus ``config.novel`` times the mean over novel views. A crop's perceptual
    distance counts for its view as if it were the distance of the whole image.

    Args:
        config: weights, and how often and on how many views the perceptual term is computed.
        targets: the views of the batch.
        iteration: number of the iteration, from 0.
        generator: draws the views and crops of the perceptual term; left alone where there is none.
        perceptual: whether the perceptual term may be chosen at all.

    Returns:
        Weights and crops, in the order of ``targets``.
    """
    novel = sum(target.novel for target in targets)
    source = len(targets) - novel
    weights = tuple(config.novel / novel if target.novel else 1.0 / source for target in targets)
    crops: list[Crop | None] = [None] * len(targets)
    if perceptual and config.perceptual > 0 and iteration % config.perceptual_every == 0:
        for is_novel in (False, True):
            candidates = [i for i, target in enumerate(targets) if target.novel == is_novel]
            # Without replacement, and in one order: more views extend the draw of fewer.
            for _ in range(min(config.perceptual_views, len(candidates))):
                i = candidates.pop(_random_below(len(candidates), generator))
                crops[i] = _random_crop(targets[i].image.pixels.shape, generator)
    return LossTerms(weights, tuple(crops))


def view_loss(
    config: LossConfig,
    color: Tensor,  # [H, W, 3]
    depth: Tensor,  # [H, W] metres, 0 where nothing was rendered
    target: Target,
) -> Tensor:
    """Computes the weighted sum of one view's L1, SSIM and depth terms with torch.

    Args:
        config: weights of the terms; the perceptual term is not computed here.
        color: rendered colour, sRGB.
        depth: rendered depth along the optical axis.
        target: what they are compared with.

    Returns:
        A scalar, differentiable in ``color`` and ``depth``; finite for any finite input, also without LiDAR returns.
    """
    loss = config.rgb * (color - target.image.pixels).abs().mean()
    # A weight of 0 skips the term: SSIM costs more than the others of a view together.
    if config.ssim > 0:
        loss = loss + config.ssim * (1.0 - ssim(color, target.image))
    if config.depth > 0 and target.depth is not None:
        loss = loss + config.depth * depth_loss(depth, target.depth)
    return loss


def depth_loss(depth: Tensor, target: Tensor) -> Tensor:
    """Computes the mean relative error of inverse depth: |1/d − 1/d̂| · d̂ = |d̂/d − 1|, clamped at 1.

    Near and far returns count alike, as the error is relative. A surface that is missing altogether cannot outweigh
    the rest, as it is in inverse depth and clamped.

    Args:
        depth: [H, W] rendered metres, 0 where nothing was rendered.
        target: [H, W] metres of the LiDAR's returns; 0, negative or not finite where there is none.

    Returns:
        The mean over pixels with a return and a rendered surface; 0 without a gradient where there is none.

    >>> float(depth_loss(torch.tensor([[4.0, 8.0]]), torch.tensor([[5.0, 0.0]])))
    0.25
    """
    valid = torch.isfinite(target) & (target > 0) & (depth > 0)
    if not bool(valid.any()):
        return depth.new_zeros(())
    # Only valid pixels are divided: a division by 0 behind a mask would still give a gradient of NaN.
    return (target[valid] / depth[valid].clamp_min(DEPTH_MIN_M) - 1.0).abs().clamp_max(DEPTH_LOSS_MAX).mean()


def image_gradients(
    config: LossConfig,
    renders: ExposedRenders,
    depth: Tensor,  # [V, H, W]
    terms: LossTerms,
    distance: ImageDistance | None = None,
) -> tuple[float, Tensor, Tensor]:
    """Computes a batch's loss and its gradients at the rendered images.

    The compiled kernel computes all but the perceptual term where tensors are float32 on the CPU; elsewhere torch does.
    Pixels that show the ego vehicle have no gradient.

    Args:
        config: weights of the terms.
        renders: of V views, with what they are compared with.
        depth: rendered depths in metres, 0 where nothing was rendered.
        terms: what :func:`select_loss_terms` chose for the views.
        distance: the perceptual distance; ``None`` leaves its term out.

    Returns:
        The loss, its gradient with respect to the scene's own colours [V, H, W, 3], and that with respect to ``depth``
        [V, H, W].
    """
    color = renders.color
    targets = renders.targets
    compute = image_loss if is_supported(color, depth, targets) else torch_image_loss
    result = compute(config, color, depth, targets, terms.weights)
    # In float64 and in the order of the views, whatever number of threads computed them.
    loss = float(result.losses.sum())
    color_gradient = result.color_gradient
    depth_gradient = result.depth_gradient
    if distance is not None:
        loss += _add_perceptual(config, color, targets, terms, distance, color_gradient)
    # The ego vehicle's own pixels are their images' and add nothing; the loss stays a mean over whole images.
    for i, target in enumerate(targets):
        if target.ego_mask is not None:
            color_gradient[i][target.ego_mask] = 0.0
            depth_gradient[i][target.ego_mask] = 0.0
    renders.undo_in_gradient(color_gradient)
    return loss, color_gradient, depth_gradient


def residual_image(renders: ExposedRenders) -> Tensor:
    """Subtracts renders from the images they are compared with, in the scene's colours without exposure gains.

    Args:
        renders: of V views, with what they are compared with.

    Returns:
        [V, H, W, 3] image minus render, 0 on the ego vehicle.
    """
    residual = torch.empty_like(renders.color)
    for i, target in enumerate(renders.targets):
        _subtract(target.image.pixels, renders.color[i], residual[i])
        if target.ego_mask is not None:
            residual[i][target.ego_mask] = 0.0
    renders.undo_in_difference(residual)
    return residual


def torch_image_loss(
    config: LossConfig, color: Tensor, depth: Tensor, targets: Sequence[Target], weights: Sequence[float]
) -> ImageLoss:
    """Computes what :func:`genre_tasks.losses.image_loss.image_loss` does, on any device and in any precision.

    Args:
        config: weights of the terms; the perceptual term is not computed here.
        color: [V, H, W, 3] rendered colours, sRGB.
        depth: [V, H, W] rendered depths in metres, 0 where nothing was rendered.
        targets: V targets.
        weights: V weights of the views.

    Returns:
        The losses of the views and the gradients of their sum, from :func:`view_loss` and torch's autograd.
    """

    def differentiate_view(i: int) -> tuple[Tensor, Tensor, Tensor]:
        view_color = color[i].detach().requires_grad_()
        view_depth = depth[i].detach().requires_grad_()
        # The caller may have gradients switched off, and on one thread this runs in the caller's.
        with torch.enable_grad():
            loss = weights[i] * view_loss(config, view_color, view_depth, targets[i])
        by_color, by_depth = torch.autograd.grad(loss, (view_color, view_depth), allow_unused=True)
        return loss.detach().double(), by_color, torch.zeros_like(view_depth) if by_depth is None else by_depth

    views = map_single_threaded(differentiate_view, range(len(targets)))
    losses, color_gradients, depth_gradients = zip(*views, strict=True)
    return ImageLoss(torch.stack(losses), torch.stack(color_gradients), torch.stack(depth_gradients))


def _add_perceptual(
    config: LossConfig,
    color: Tensor,
    targets: Sequence[Target],
    terms: LossTerms,
    distance: ImageDistance,
    color_gradient: Tensor,
) -> float:
    """The perceptual loss of the views that have a crop; adds its gradient to ``color_gradient`` in place."""

    def add_view(view_and_crop: tuple[int, Crop]) -> float:
        i, (row, column, height, width) = view_and_crop
        window = slice(row, row + height), slice(column, column + width)
        rendered = color[i][window].detach().requires_grad_()
        with torch.enable_grad():
            value = distance(rendered[None].clamp(0, 1), targets[i].image.pixels[window][None])[0]
            loss = terms.weights[i] * config.perceptual * value
        color_gradient[i][window] += torch.autograd.grad(loss, rendered)[0]
        return float(loss.detach())

    crops = [(i, crop) for i, crop in enumerate(terms.crops) if crop is not None]
    return sum(map_single_threaded(add_view, crops))


def _subtract(a: Tensor, b: Tensor, out: Tensor) -> None:
    # On the CPU by numpy, because torch would wake its threads, which then spin beside the kernels' threads.
    if out.device.type == "cpu":
        np.subtract(a.numpy(), b.numpy(), out=out.numpy())
    else:
        torch.sub(a, b, out=out)


def _random_below(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (1,), generator=generator))


def _random_crop(shape: torch.Size, generator: torch.Generator) -> Crop:
    height = min(CROP_PX, shape[0])
    width = min(CROP_PX, shape[1])
    # Drawn even where only one crop fits, so that the number of draws does not depend on the size of the image.
    row = _random_below(shape[0] - height + 1, generator)
    column = _random_below(shape[1] - width + 1, generator)
    return row, column, height, width
