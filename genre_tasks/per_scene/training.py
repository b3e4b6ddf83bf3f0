"""Per-scene 3DGS by the published recipe: Adam, one random view in each iteration, density control.

It follows gsplat's ``simple_trainer``, that is Kerbl et al. (2023) at degree 0 of spherical harmonics. Two things
differ because of this renderer's scenes. Colours are plain RGB = C0 · SH + 1/2, so that their learning rate is C0 times
that of the constant harmonic: Adam's step does not depend on the gradient's scale. Lengths of an actor are measured by
its box, as in Street Gaussians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.config import LossConfig, PerSceneConfig
from genre_tasks.errors import NonFiniteError
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import image_gradients, select_loss_terms
from genre_tasks.losses.targets import Target
from genre_tasks.per_scene.densification import GaussiansWithMoments, densify, prune, reset_opacity
from genre_tasks.per_scene.screen_gradient import screen_space_gradient
from genre_tasks.per_scene.setup import measure_node_extents, scale_density_schedule
from genre_tasks.render.api import build_cameras, concatenate_renders, render, with_shutter_velocities
from genre_tasks.render.motion_blur import BlurSamples
from genre_tasks.render.types import Render
from genre_tasks.scene.gaussians import Gaussians, Splats, map_attributes
from genre_tasks.scene.graph import SceneGraph

SH_C0 = 0.28209479177387814
"""1 / (2 √π), the constant spherical harmonic."""

FIRST_DECAY = 0.9
SECOND_DECAY = 0.999
EPSILON = 1e-15
"""Adam's parameters in the published recipe."""

_PARTS = ("gaussians", "first_moments", "second_moments")


class PerSceneTraining:
    """A training of 3D Gaussian Splatting on the views of one scene, one iteration at a time.

    It can be left after any iteration. :meth:`state` and :meth:`restore` carry it over an interruption, after which it
    goes on with the same bytes. These are the same at any number of threads.

    Args:
        config: learning rates, loss weights and the schedule of density control.
        scene: where the training starts; it is copied.
        source: the supervised views.
        seed: of the order of views and of split Gaussians.
        stage: the stage that errors name.

    Attributes:
        iteration: iterations done so far.
        seconds: time that the training took, without what the caller did in between.
        density: the schedule of density control in iterations of this run.
        culled: Gaussians that the last render left out, by reason.
    """

    def __init__(
        self, config: PerSceneConfig, scene: SceneGraph, source: Sequence[Target], seed: int = 0, stage: str = "gnet"
    ) -> None:
        started = time.perf_counter()
        self.config = config
        self.source = tuple(source)
        self.stage = stage
        self.density = scale_density_schedule(config, len(source))
        self.iteration = 0
        self.culled: dict[str, int] = {}
        self._actors = scene.actors
        self._antialiased = scene.antialiased
        self._extents = measure_node_extents(scene, source)
        # Steps work in place: they must not reach the caller's scene.
        copies = map_attributes(lambda x: x.detach().clone(memory_format=torch.contiguous_format), scene.gaussians)
        self._replace_gaussians(GaussiansWithMoments.with_zero_moments(copies, scene.nodes))
        self._generator = torch.Generator().manual_seed(seed)
        self._remaining_views: list[int] = []
        # The published recipe has no perceptual term.
        self._loss = LossConfig(rgb=config.rgb, ssim=config.ssim, perceptual=0.0, depth=config.depth)
        self.seconds = time.perf_counter() - started

    def __len__(self) -> int:
        """The present number of Gaussians."""
        return len(self._trained)

    @property
    def scene(self) -> SceneGraph:
        """A copy of the scene as it is now.

        Raises:
            NonFiniteError: a Gaussian is not finite.
        """
        copies = map_attributes(lambda x: x.detach().clone(), self._trained.gaussians)
        check_finite(copies.pack(), "Gaussians", self.stage)
        return SceneGraph(copies, self._trained.nodes, self._actors, self._antialiased)

    def step(self) -> float:
        """Does one iteration: renders a view, moves the Gaussians, and adds or removes some when it is time.

        Returns:
            The loss before the step.

        Raises:
            NonFiniteError: the loss is not finite.
        """
        started = time.perf_counter()
        loss, gradient = self._differentiate(self.source[self._draw_view()])
        if not math.isfinite(loss):
            raise NonFiniteError(self.stage, "loss", 1, (self.iteration,))
        self._apply_adam(gradient)
        self.iteration += 1
        if self.iteration < self.density.stop:
            self._control_density()
        self.seconds += time.perf_counter() - started
        return loss

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Copies everything that changes during the training.

        Returns:
            The tensors by name, and the plain values by name, for :meth:`restore`.
        """
        trained = self._trained
        tensors = {
            f"{part}.{field.name}": getattr(getattr(trained, part), field.name)
            for part in _PARTS
            for field in fields(Gaussians)
        }
        tensors["nodes"] = trained.nodes
        tensors["screen_gradient"] = self._screen_gradient
        tensors["view_count"] = self._view_count
        tensors["random"] = self._generator.get_state()
        values = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "remaining_views": list(self._remaining_views),
        }
        return {name: tensor.detach().clone() for name, tensor in tensors.items()}, values

    def restore(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Continues from a state, on a training of the same scene, views and configuration.

        Args:
            tensors: the first result of :meth:`state`.
            values: the second one.
        """
        gaussians, first_moments, second_moments = (
            Gaussians(*(tensors[f"{part}.{field.name}"].clone() for field in fields(Gaussians))) for part in _PARTS
        )
        self._replace_gaussians(
            GaussiansWithMoments(gaussians, first_moments, second_moments, tensors["nodes"].clone())
        )
        self._screen_gradient = tensors["screen_gradient"].clone()
        self._view_count = tensors["view_count"].clone()
        self._generator.set_state(tensors["random"])
        self.iteration = values["iteration"]
        self.seconds = values["seconds"]
        self._remaining_views = list(values["remaining_views"])

    def _replace_gaussians(self, trained: GaussiansWithMoments) -> None:
        """Takes other Gaussians, and resets their statistics for density control."""
        self._trained = trained
        self._extent = self._extents[trained.nodes]
        self._screen_gradient = torch.zeros(len(trained))
        self._view_count = torch.zeros(len(trained))

    def _draw_view(self) -> int:
        # A random order of all views, then another one: each view comes once in as many iterations as there are views.
        if not self._remaining_views:
            self._remaining_views = torch.randperm(len(self.source), generator=self._generator).tolist()
        return self._remaining_views.pop()

    def _differentiate(self, target: Target) -> tuple[float, Gaussians]:
        """Loss and gradient of one view; adds to the statistics of density control."""
        leaves = map_attributes(lambda x: x.detach().requires_grad_(), self._trained.gaussians)
        scene = SceneGraph(leaves, self._trained.nodes, self._actors, self._antialiased)
        with torch.enable_grad():
            samples = _render_samples(scene, target)
        image = samples.image
        terms = select_loss_terms(self._loss, [target], self.iteration, self._generator, perceptual=False)
        # Only a depth term needs depth in metres: without it the division by alpha would cost time for nothing.
        depth = image.depth
        if self._loss.depth > 0:
            with torch.enable_grad():
                depth = image.expected_depth()
        exposed = ExposedRenders.from_renders(image.color, [target])
        loss, color_gradient, depth_gradient = image_gradients(self._loss, exposed, depth, terms)
        if self._loss.depth > 0:
            # One pass for both outputs, since they share a graph.
            torch.autograd.backward([image.color, depth], [color_gradient, depth_gradient])
        else:
            image.color.backward(color_gradient)
        self.culled = image.culled
        # Nobody asks for the statistics after the last densification.
        if self.iteration + 1 < self.density.stop:
            # Of a blurred view the middle moment stands for all: the view's pose belongs to it.
            middle = len(samples.placed) // 2
            screen_gradient, visible = screen_space_gradient(
                samples.placed[middle].means.detach(),
                _sum_mean_gradients(samples.placed),
                samples.splats[middle].scales.detach().amax(1),
                target.chunk_SE3_camera,
                target.lens,
            )
            self._screen_gradient += screen_gradient
            self._view_count += visible
        return loss, map_attributes(lambda x: x.grad, leaves)

    def _apply_adam(self, gradient: Gaussians) -> None:
        """Moves the Gaussians in place by Adam's step (Kingma and Ba 2015)."""
        config = self.config
        step_number = self.iteration + 1
        # In the order of a Gaussian's attributes, each with the schedule of the published recipe.
        learning_rates = {
            "means": config.means_lr * config.means_lr_end_fraction ** (self.iteration / config.iterations),
            "log_scales": config.log_scales_lr,
            "quats": config.quats_lr,
            "logit_opacities": config.logit_opacities_lr,
            "colors": SH_C0 * config.sh_lr,
        }
        root = math.sqrt(1 - SECOND_DECAY**step_number)
        bias_correction = root / (1 - FIRST_DECAY**step_number)
        for name, learning_rate in learning_rates.items():
            x = getattr(self._trained.gaussians, name)
            m = getattr(self._trained.first_moments, name)
            v = getattr(self._trained.second_moments, name)
            g = getattr(gradient, name)
            # Products and sums stand apart: fused ones round differently at the ends of the threads' pieces.
            m.mul_(FIRST_DECAY).add_(g * (1 - FIRST_DECAY))
            v.mul_(SECOND_DECAY).add_((g * g).mul_(1 - SECOND_DECAY))
            step = v.sqrt().add_(EPSILON * root)
            torch.div(m, step, out=step).mul_(learning_rate * bias_correction)
            x.sub_(step.mul_(self._extent[:, None]) if name == "means" else step)

    def _control_density(self) -> None:
        schedule = self.density
        if self.iteration > schedule.start and self.iteration % schedule.every == 0:
            mean_gradient = self._screen_gradient / self._view_count.clamp_min(1)
            self._replace_gaussians(densify(self._trained, mean_gradient, self._extent, schedule, self._generator))
            # As in gsplat, large Gaussians are pruned only after the first reset of opacities.
            too_large = self.iteration > schedule.reset_every
            self._replace_gaussians(prune(self._trained, self._extent, schedule, too_large))
        if self.iteration % schedule.reset_every == 0:
            self._trained = reset_opacity(self._trained, schedule)


@dataclass(frozen=True)
class _ViewSamples:
    """One view's render, and what was rendered at each of its moments (one, or several where motion blurs it)."""

    image: Render
    placed: list[Gaussians]
    splats: list[Splats]


def _render_samples(scene: SceneGraph, target: Target) -> _ViewSamples:
    """Renders a view, and keeps the means at its moments, whose gradients density control needs."""
    blur = BlurSamples.from_views([target])
    views = (target,) if blur is None else blur.views
    placed = [scene.gaussians_at(view.frame) for view in views]
    for gaussians in placed:
        gaussians.means.retain_grad()
    splats = [with_shutter_velocities(g.activate(), scene, v) for g, v in zip(placed, views, strict=True)]
    images = [render(s, build_cameras([v], scene.antialiased)) for s, v in zip(splats, views, strict=True)]
    image = images[0] if blur is None else blur.average(concatenate_renders(images, range(len(images))))
    return _ViewSamples(image, placed, splats)


def _sum_mean_gradients(placed: Sequence[Gaussians]) -> Tensor:
    """[N, 3] gradient with respect to the means, summed over the moments of a view."""
    # A scene without actors has one and the same tensor of means at all moments: its gradient counts once.
    distinct = {id(gaussians.means): gaussians.means for gaussians in placed}
    gradients = [means.grad for means in distinct.values() if means.grad is not None]
    return gradients[0] if len(gradients) == 1 else torch.stack(gradients).sum(0)
