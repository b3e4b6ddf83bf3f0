"""One render of the Gaussians at some offsets, and the gradient with respect to the offsets: compiled, or torch's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from genre_tasks.metrics.threads import map_single_threaded
from genre_tasks.optimiser import posing
from genre_tasks.optimiser.fused_library import takes
from genre_tasks.optimiser.state import Frame
from genre_tasks.render import cpu
from genre_tasks.render.api import cameras_of, render_views, velocities_of
from genre_tasks.render.blur import Moments, PosedView, mean, mean_gradient
from genre_tasks.render.types import RenderSettings


class Pass(Protocol):
    """``color`` [V, H, W, 3], expected ``depth`` [V, H, W] and ``culled`` as in ``Render``."""

    color: Tensor
    depth: Tensor
    culled: dict[str, int]

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """[N, 14] with respect to the offsets, from the gradients of the images; once, and they are used up."""


class TorchPass:
    """By torch's autograd, on any device and in any precision: the oracle of :class:`CompiledPass`."""

    def __init__(self, frame: Frame, offsets: Tensor, views: Sequence[PosedView], settings: RenderSettings) -> None:
        self._leaf = offsets.detach().requires_grad_()
        with torch.enable_grad():
            image = render_views(frame.scene.with_gaussians(frame.gaussians(self._leaf)), views, settings)
            self._depth = image.expected_depth()
        self._color, self.culled = image.color, image.culled
        self.color, self.depth = image.color.detach(), self._depth.detach()

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """As in :class:`Pass`."""
        torch.autograd.backward([self._color, self._depth], [by_color, by_depth])
        assert self._leaf.grad is not None
        return self._leaf.grad


class CompiledPass:
    """By kernels only, in float32 on the CPU: torch's autograd around the renderer costs as much as two views."""

    def __init__(self, frame: Frame, offsets: Tensor, views: Sequence[PosedView], settings: RenderSettings) -> None:
        self._posing, self._threads = frame.posing, settings.threads or torch.get_num_threads()
        frames = [v.frame for v in views]
        self._posed = self._posing.splats(offsets.detach(), list(dict.fromkeys(frames)), self._threads)
        splats, shown = self._posed.splats, self._posing.shown(frames)
        velocities = velocities_of(frame.scene, splats[0], views)
        self._images, self.culled, self._batch = cpu.forward(
            splats, cameras_of(views, frame.scene.antialiased), shown, self._threads, keep=True, velocities=velocities
        )
        self.color, self._alpha = self._images[:2]
        self.depth = posing.expected_depth(*self._images[1:])

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """As in :class:`Pass`."""
        by_alpha, by_depth = posing.expected_depth_gradient(self._alpha, self.depth, by_depth.contiguous())
        by_splats = posing.arrays(len(self._posed.splats[0]))
        by_images = by_color, by_alpha, by_depth
        assert self._batch is not None
        cpu.backward(self._batch, self._posed.splats, self._images, by_images, self._threads, by_splats)
        return self._posing.gradient(self._posed, by_splats, self._threads)


class BlurredPass:
    """Of views with motion blur, from a pass of their moments; ``depth`` is that at the poses' own times."""

    def __init__(self, sharp: Pass, moments: Moments) -> None:
        self._sharp, self._moments = sharp, moments
        self.color = torch.stack(map_single_threaded(lambda part: mean(sharp.color[part]), moments.parts))
        self.depth, self.culled = sharp.depth[moments.middle], sharp.culled

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """As in :class:`Pass`."""
        sharp, parts = self._sharp, self._moments.parts
        pairs = list(zip(parts, by_color, strict=True))
        by_moments = torch.cat(map_single_threaded(lambda pair: mean_gradient(sharp.color[pair[0]], pair[1]), pairs))
        by_depths = torch.zeros_like(sharp.depth)
        by_depths[self._moments.middle] = by_depth
        return sharp.gradient(by_moments, by_depths)


def begin(frame: Frame, offsets: Tensor, views: Sequence[PosedView], settings: RenderSettings) -> Pass:
    """The render of ``views`` at ``offsets`` [N, 14], by kernels where they are made for it."""
    compiled = settings.backend in ("auto", "cpu") and takes(offsets, frame.start, frame.unit)
    kind: Callable[..., Pass] = CompiledPass if compiled else TorchPass
    moments = Moments.of(views)
    if moments is None:
        return kind(frame, offsets, views, settings)
    return BlurredPass(kind(frame, offsets, moments.views, settings), moments)
