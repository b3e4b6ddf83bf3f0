"""One render of the Gaussians at some offsets, and the gradient with respect to the offsets: compiled, or torch's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels import posing
from genre_tasks.optimiser.kernels.library import takes
from genre_tasks.optimiser.state import Frame
from genre_tasks.render import cpu
from genre_tasks.render.api import cameras_of, colors_of, render_views, velocities_of
from genre_tasks.render.motion_blur import Moments, PosedView, mean, mean_gradient
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.threads import map_single_threaded

if TYPE_CHECKING:
    from genre_tasks.optimiser.deformation_optimiser import Shift
    from genre_tasks.optimiser.sh_optimiser import GlossSight
    from genre_tasks.scene.deformation import Deformation


@dataclass(frozen=True)
class Beside:
    """What is fitted beside the offsets, as it is now.

    ``deformation``: how actors deform; ``None``: they are rigid. ``harmonics`` [N, K, 3]: of colours, if any.
    """

    deformation: Deformation | None = None
    harmonics: Tensor | None = None


RIGID_AND_DULL = Beside()


class Pass(Protocol):
    """``color`` [V, H, W, 3], expected ``depth`` [V, H, W] and ``culled`` as in ``Render``.

    ``by_deformation``: after :meth:`gradient`, as the deformation's ``offsets``; ``None`` where actors are rigid.
    ``residuals`` [N, 5]: after it, where it was given a residual image r: the sums over all pixels of w r, w ‖r‖² and
    w, with w a Gaussian's share of the pixel.
    """

    color: Tensor
    depth: Tensor
    culled: dict[str, int]
    by_deformation: Tensor | None
    gloss: GlossSight | None
    residuals: Tensor | None

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, shares: Tensor | None = None
    ) -> Tensor:
        """[N, 14] with respect to the offsets, from the gradients of the images; once, and they are used up.

        Where there are harmonics, ``gloss`` is what these views tell of them from then on. ``residual`` [V, H, W, 3]:
        see ``residuals``; ``shares`` [V]: how much each view counts in them, 1 if not given.
        """


class TorchPass:
    """By torch's autograd, on any device and in any precision: the oracle of :class:`CompiledPass`."""

    def __init__(
        self,
        frame: Frame,
        offsets: Tensor,
        views: Sequence[PosedView],
        settings: RenderSettings,
        beside: Beside = RIGID_AND_DULL,
    ) -> None:
        deformation, harmonics = beside.deformation, beside.harmonics
        self._leaf, scene = offsets.detach().requires_grad_(), frame.scene
        self._moves = (scene.nodes >= FIRST_ACTOR) & bool(scene.actors)
        self._nodes = None if deformation is None else deformation.offsets.detach().requires_grad_()
        self._harmonics = None if harmonics is None else harmonics.detach().requires_grad_()
        self.by_deformation: Tensor | None = None
        if deformation is not None and self._nodes is not None:
            scene = replace(scene, deformation=deformation.with_offsets(self._nodes))
        with torch.enable_grad():
            scene = scene.with_gaussians(frame.gaussians(self._leaf)).with_harmonics(self._harmonics)
            self._seen = None if harmonics is None else colors_of(scene, views)
            image = render_views(scene, views, settings, self._seen)
            self._depth = image.expected_depth()
        self._color, self.culled = image.color, image.culled
        self.color, self.depth = image.color.detach(), self._depth.detach()
        self.gloss: GlossSight | None = None
        self.residuals: Tensor | None = None

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, shares: Tensor | None = None
    ) -> Tensor:
        """As in :class:`Pass`."""
        if residual is not None:
            self.residuals = self._shown_of(residual, shares)
        if self._seen is not None:
            self._seen.retain_grad()
        torch.autograd.backward([self._color, self._depth], [by_color, by_depth], retain_graph=self._seen is not None)
        assert self._leaf.grad is not None
        self.by_deformation = None if self._nodes is None else self._nodes.grad
        if self._seen is not None and self._seen.grad is not None and self._harmonics is not None:
            from genre_tasks.optimiser.sh_optimiser import GlossSight

            leaves = self._leaf, self._harmonics
            views, sums = torch.autograd.grad(self._seen, leaves, drawn(self._seen.grad))
            assert self._harmonics.grad is not None
            self.gloss = GlossSight(self._harmonics.grad, sums, views[:, 11:14])
        return self._leaf.grad

    def _shown_of(self, residual: Tensor, shares: Tensor | None) -> Tensor:
        """[N, 5], by the gradients of the colours: a pixel's colour is linear in them, with w as its slope."""
        square = residual.square().sum(-1)
        others = torch.stack([square, torch.ones_like(square), torch.zeros_like(square)], -1)
        if shares is not None:
            residual, others = (shares.to(square)[:, None, None, None] * image for image in (residual, others))
        of = self._leaf if self._seen is None else self._seen  # what views see of harmonics is held above 0
        grads = [torch.autograd.grad(self._color, of, image, retain_graph=True)[0] for image in (residual, others)]
        found = torch.cat([grads[0][..., -3:], grads[1][..., -3:-1]], -1)
        return found if self._seen is None else self._own(found.sum(0))

    def _own(self, posed: Tensor) -> Tensor:
        """Sums [N, C] over the frames of values [N', C] that are laid out as by ``SceneGraph.posed``."""
        moves = self._moves
        still = int((~moves).sum())
        out = posed.new_zeros((len(moves), posed.shape[1]))
        out[~moves] = posed[:still]
        out[moves] = posed[still:].reshape(-1, int(moves.sum()), posed.shape[1]).sum(0)
        return out


class CompiledPass:
    """By kernels only, in float32 on the CPU: torch's autograd around the renderer costs as much as two views."""

    def __init__(
        self,
        frame: Frame,
        offsets: Tensor,
        views: Sequence[PosedView],
        settings: RenderSettings,
        beside: Beside = RIGID_AND_DULL,
    ) -> None:
        self._posing, self._threads = frame.posing, settings.threads or torch.get_num_threads()
        frames = [v.frame for v in views]
        self._posed = self._posing.splats(offsets.detach(), list(dict.fromkeys(frames)), self._threads)
        splats, shown = self._posed.splats, self._posing.shown(frames)
        self.by_deformation: Tensor | None = None
        self._shift = _shift(frame, offsets.detach(), list(dict.fromkeys(frames)), splats[0], beside.deformation)
        velocities = velocities_of(frame.scene, splats[0], views)
        self._shown = None if beside.harmonics is None else Shine(frame, offsets, beside.harmonics, views)
        if self._shown is not None:
            splats = (*splats[:4], self._shown.colors.detach())
        self._splats = splats
        self._images, self.culled, self._batch = cpu.forward(
            splats, cameras_of(views, frame.scene.antialiased), shown, self._threads, keep=True, velocities=velocities
        )
        self.color, self._alpha = self._images[:2]
        self.depth = posing.expected_depth(*self._images[1:])
        self.gloss: GlossSight | None = None
        self.residuals: Tensor | None = None

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, shares: Tensor | None = None
    ) -> Tensor:
        """As in :class:`Pass`."""
        by_alpha, by_depth = posing.expected_depth_gradient(self._alpha, self.depth, by_depth.contiguous())
        by_splats = posing.arrays(len(self._posed.splats[0]))
        by_images = by_color, by_alpha, by_depth
        assert self._batch is not None
        if self._shown is None:
            shown = self._backward(by_images, by_splats, residual, shares)
            out = self._posing.gradient(self._posed, by_splats, self._threads)
        else:
            out, shown = self._glossy_gradient(self._shown, by_images, by_splats, residual, shares)
        if shown is not None:
            self.residuals = self._posing.residuals(self._posed, shown, self._threads)
        if self._shift is not None:
            self.by_deformation = self._shift.gradient(by_splats[0], out)
        return out

    def _backward(
        self, by_images: cpu.Images, by_splats: cpu.Arrays, residual: Tensor | None, shares: Tensor | None
    ) -> Tensor | None:
        assert self._batch is not None
        told = residual, shares
        return cpu.backward(self._batch, self._splats, self._images, by_images, self._threads, by_splats, *told)

    def _glossy_gradient(
        self,
        shown: Shine,
        by_images: cpu.Images,
        by_splats: cpu.Arrays,
        residual: Tensor | None,
        shares: Tensor | None,
    ) -> tuple[Tensor, Tensor | None]:
        by_colors = torch.empty_like(self._splats[4])
        residuals = self._backward(by_images, (*by_splats[:4], by_colors), residual, shares)
        by_splats[4].zero_()
        out = self._posing.gradient(self._posed, by_splats, self._threads)
        by_means, by_own, self.gloss = shown.gradient(by_colors)
        out[:, 0:3] += by_means
        out[:, 11:14] += by_own
        return out, residuals


class Shine:
    """What views see of a scene with harmonics, and the way back; by torch's autograd.

    ``colors`` [V, N', 3], laid out as by ``SceneGraph.posed``.
    """

    def __init__(self, frame: Frame, offsets: Tensor, harmonics: Tensor, views: Sequence[PosedView]) -> None:
        at = frame.gaussians(offsets.detach())
        self._unit = frame.unit
        self._leaves = [t.detach().requires_grad_() for t in (at.means, at.colors, harmonics)]
        means, colors, harmonics = self._leaves
        with torch.enable_grad():
            scene = frame.scene.with_gaussians(replace(at, means=means, colors=colors)).with_harmonics(harmonics)
            self.colors = colors_of(scene, views)

    def gradient(self, by_colors: Tensor) -> tuple[Tensor, Tensor, GlossSight]:
        """By the offsets of means [N, 3] and of colours [N, 3], and what the views tell of harmonics."""
        from genre_tasks.optimiser.sh_optimiser import GlossSight

        of = self.colors, self._leaves
        by_means, by_own, by_harmonics = torch.autograd.grad(*of, by_colors, retain_graph=True)
        _, views, sums = torch.autograd.grad(*of, drawn(by_colors))
        return by_means * self._unit, by_own, GlossSight(by_harmonics, sums, views)


def drawn(by_colors: Tensor) -> Tensor:
    """1 where a view's gradient [V, N', 3] says that it has drawn a Gaussian, else 0."""
    return (by_colors != 0).any(-1, keepdim=True).to(by_colors.dtype).expand_as(by_colors).contiguous()


class BlurredPass:
    """Of views with motion blur, from a pass of their moments; ``depth`` is that at the poses' own times."""

    def __init__(self, sharp: Pass, moments: Moments) -> None:
        self._sharp, self._moments = sharp, moments
        self.by_deformation: Tensor | None = None
        self.gloss: GlossSight | None = None
        self.residuals: Tensor | None = None
        self.color = torch.stack(map_single_threaded(lambda part: mean(sharp.color[part]), moments.parts))
        self.depth, self.culled = sharp.depth[moments.middle], sharp.culled

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, shares: Tensor | None = None
    ) -> Tensor:
        """As in :class:`Pass`; a view's residual is that of each of its moments, each an equal share of its pixels."""
        sharp, parts = self._sharp, self._moments.parts
        pairs = list(zip(parts, by_color, strict=True))
        by_moments = torch.cat(map_single_threaded(lambda pair: mean_gradient(sharp.color[pair[0]], pair[1]), pairs))
        by_depths = torch.zeros_like(sharp.depth)
        by_depths[self._moments.middle] = by_depth
        if residual is not None:
            counts = torch.tensor([part.stop - part.start for part in parts])
            own = torch.ones(len(parts)) if shares is None else shares
            residual, shares = (x.repeat_interleave(counts.to(x.device), 0) for x in (residual, own / counts))
        out = sharp.gradient(by_moments, by_depths, residual, shares)
        self.by_deformation, self.gloss, self.residuals = sharp.by_deformation, sharp.gloss, sharp.residuals
        return out


def _shift(
    frame: Frame, offsets: Tensor, frames: Sequence[float], means: Tensor, deformation: Deformation | None
) -> Shift | None:
    """The deformation, done to the splats' ``means``; ``None`` where actors are rigid."""
    if deformation is None:
        return None
    from genre_tasks.optimiser.deformation_optimiser import Shift

    return Shift(frame, offsets, frames, means, deformation)


def begin(
    frame: Frame,
    offsets: Tensor,
    views: Sequence[PosedView],
    settings: RenderSettings,
    beside: Beside = RIGID_AND_DULL,
) -> Pass:
    """The render of ``views`` at ``offsets`` [N, 14], by kernels where they are made for it."""
    compiled = settings.backend in ("auto", "cpu") and takes(offsets, frame.start, frame.unit)
    kind: Callable[..., Pass] = CompiledPass if compiled else TorchPass
    moments = Moments.of(views)
    if moments is None:
        return kind(frame, offsets, views, settings, beside)
    return BlurredPass(kind(frame, offsets, moments.views, settings, beside), moments)
