"""One render of the Gaussians at some offsets, and the gradient with respect to the offsets: compiled, or torch's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

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

if TYPE_CHECKING:
    from genre_tasks.optimiser.deforming import Shift
    from genre_tasks.scene.deformation import Deformation


class Pass(Protocol):
    """``color`` [V, H, W, 3], expected ``depth`` [V, H, W] and ``culled`` as in ``Render``.

    ``by_deformation``: after :meth:`gradient`, as the deformation's ``offsets``; ``None`` where actors are rigid.
    """

    color: Tensor
    depth: Tensor
    culled: dict[str, int]
    by_deformation: Tensor | None

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """[N, 14] with respect to the offsets, from the gradients of the images; once, and they are used up."""


class TorchPass:
    """By torch's autograd, on any device and in any precision: the oracle of :class:`CompiledPass`."""

    def __init__(
        self,
        frame: Frame,
        offsets: Tensor,
        views: Sequence[PosedView],
        settings: RenderSettings,
        deformation: Deformation | None = None,
    ) -> None:
        self._leaf, scene = offsets.detach().requires_grad_(), frame.scene
        self._nodes = None if deformation is None else deformation.offsets.detach().requires_grad_()
        self.by_deformation: Tensor | None = None
        if deformation is not None and self._nodes is not None:
            scene = replace(scene, deformation=deformation.with_offsets(self._nodes))
        with torch.enable_grad():
            image = render_views(scene.with_gaussians(frame.gaussians(self._leaf)), views, settings)
            self._depth = image.expected_depth()
        self._color, self.culled = image.color, image.culled
        self.color, self.depth = image.color.detach(), self._depth.detach()

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """As in :class:`Pass`."""
        torch.autograd.backward([self._color, self._depth], [by_color, by_depth])
        assert self._leaf.grad is not None
        self.by_deformation = None if self._nodes is None else self._nodes.grad
        return self._leaf.grad


class CompiledPass:
    """By kernels only, in float32 on the CPU: torch's autograd around the renderer costs as much as two views."""

    def __init__(
        self,
        frame: Frame,
        offsets: Tensor,
        views: Sequence[PosedView],
        settings: RenderSettings,
        deformation: Deformation | None = None,
    ) -> None:
        self._posing, self._threads = frame.posing, settings.threads or torch.get_num_threads()
        frames = [v.frame for v in views]
        self._posed = self._posing.splats(offsets.detach(), list(dict.fromkeys(frames)), self._threads)
        splats, shown = self._posed.splats, self._posing.shown(frames)
        self.by_deformation: Tensor | None = None
        self._shift = _shift(frame, offsets.detach(), list(dict.fromkeys(frames)), splats[0], deformation)
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
        out = self._posing.gradient(self._posed, by_splats, self._threads)
        if self._shift is not None:
            self.by_deformation = self._shift.gradient(by_splats[0], out)
        return out


class BlurredPass:
    """Of views with motion blur, from a pass of their moments; ``depth`` is that at the poses' own times."""

    def __init__(self, sharp: Pass, moments: Moments) -> None:
        self._sharp, self._moments = sharp, moments
        self.by_deformation: Tensor | None = None
        self.color = torch.stack(map_single_threaded(lambda part: mean(sharp.color[part]), moments.parts))
        self.depth, self.culled = sharp.depth[moments.middle], sharp.culled

    def gradient(self, by_color: Tensor, by_depth: Tensor) -> Tensor:
        """As in :class:`Pass`."""
        sharp, parts = self._sharp, self._moments.parts
        pairs = list(zip(parts, by_color, strict=True))
        by_moments = torch.cat(map_single_threaded(lambda pair: mean_gradient(sharp.color[pair[0]], pair[1]), pairs))
        by_depths = torch.zeros_like(sharp.depth)
        by_depths[self._moments.middle] = by_depth
        out = sharp.gradient(by_moments, by_depths)
        self.by_deformation = sharp.by_deformation
        return out


def _shift(
    frame: Frame, offsets: Tensor, frames: Sequence[float], means: Tensor, deformation: Deformation | None
) -> Shift | None:
    """The deformation, done to the splats' ``means``; ``None`` where actors are rigid."""
    if deformation is None:
        return None
    from genre_tasks.optimiser.deforming import Shift

    return Shift(frame, offsets, frames, means, deformation)


def begin(
    frame: Frame,
    offsets: Tensor,
    views: Sequence[PosedView],
    settings: RenderSettings,
    deformation: Deformation | None = None,
) -> Pass:
    """The render of ``views`` at ``offsets`` [N, 14], by kernels where they are made for it.

    ``deformation``: how actors deform now; ``None``: they are rigid.
    """
    compiled = settings.backend in ("auto", "cpu") and takes(offsets, frame.start, frame.unit)
    kind: Callable[..., Pass] = CompiledPass if compiled else TorchPass
    moments = Moments.of(views)
    if moments is None:
        return kind(frame, offsets, views, settings, deformation)
    return BlurredPass(kind(frame, offsets, moments.views, settings, deformation), moments)
