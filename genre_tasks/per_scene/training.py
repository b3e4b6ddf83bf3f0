"""Per-scene 3DGS by the published recipe: Adam, one random view in each iteration, density control.

As gsplat's ``simple_trainer``: Kerbl et al. (2023) at degree 0 of spherical harmonics. What this renderer's scenes make
different: colours are plain RGB = C0 · SH + 1/2, so that their rate is C0 times that of the SH constant (Adam's step
does not depend on the gradient's scale); and lengths of an actor are measured by its box, as in Street Gaussians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.config import LossConfig, PerSceneConfig
from genre_tasks.errors import NonFiniteError
from genre_tasks.losses.rendering_loss import image_gradients, plan_loss
from genre_tasks.losses.targets import Target
from genre_tasks.per_scene import densification
from genre_tasks.per_scene.densification import Population
from genre_tasks.per_scene.screen_gradient import screen_pull
from genre_tasks.per_scene.setup import node_extents, timetable
from genre_tasks.render.api import cameras_of, in_order, moving, render
from genre_tasks.render.motion_blur import Moments
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import SceneGraph

SH_C0 = 0.28209479177387814
"""1 / (2 √π), the constant spherical harmonic."""

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-15


class PerSceneTraining:
    """The whole state of a training; ``step`` advances it by one iteration and can be the last at any time.

    ``state`` and ``restore`` carry it over an interruption: it goes on with the same bytes. They are the same at any
    number of threads. ``seconds`` counts what the training took, and nothing in between.
    """

    def __init__(
        self, config: PerSceneConfig, scene: SceneGraph, source: Sequence[Target], seed: int = 0, stage: str = "gnet"
    ) -> None:
        began = time.perf_counter()
        self.config, self.source, self.stage = config, tuple(source), stage
        self.table = timetable(config, len(source))
        self.iteration = 0
        self.culled: dict[str, int] = {}
        self._actors = scene.actors
        self._antialiased = scene.antialiased
        self._extents = node_extents(scene, source)
        copies = map_attributes(lambda x: x.detach().clone(memory_format=torch.contiguous_format), scene.gaussians)
        self._set(Population.newborn(copies, scene.nodes))
        self._generator = torch.Generator().manual_seed(seed)
        self._waiting: list[int] = []
        self._loss = LossConfig(rgb=config.rgb, ssim=config.ssim, perceptual=0.0, depth=config.depth)
        self.seconds = time.perf_counter() - began

    def __len__(self) -> int:
        """Gaussians at present."""
        return len(self._population)

    @property
    def scene(self) -> SceneGraph:
        """A copy of the scene as it is now. Raises ``NonFiniteError``."""
        copies = map_attributes(lambda x: x.detach().clone(), self._population.gaussians)
        check_finite(copies.packed(), "Gaussians", self.stage)
        return SceneGraph(copies, self._population.nodes, self._actors, self._antialiased)

    def step(self) -> float:
        """One iteration; returns the loss before it. Raises ``NonFiniteError``."""
        began = time.perf_counter()
        loss, gradient = self._look(self.source[self._next_view()])
        if not math.isfinite(loss):
            raise NonFiniteError(self.stage, "loss", 1, (self.iteration,))
        self._move(gradient)
        self.iteration += 1
        if self.iteration < self.table.stop:
            self._control()
        self.seconds += time.perf_counter() - began
        return loss

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that changes, as tensors and as plain values."""
        p = self._population
        tensors = {f"{kind}.{f.name}": getattr(getattr(p, kind), f.name) for kind in _KINDS for f in fields(Gaussians)}
        tensors |= {"nodes": p.nodes, "pull": self._pull, "views": self._views, "random": self._generator.get_state()}
        values = {"iteration": self.iteration, "seconds": self.seconds, "waiting": list(self._waiting)}
        return {name: t.detach().clone() for name, t in tensors.items()}, values

    def restore(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """The inverse of :meth:`state`, on a training of the same scene, views and configuration."""
        gaussians, first, second = (
            Gaussians(*(tensors[f"{kind}.{f.name}"].clone() for f in fields(Gaussians))) for kind in _KINDS
        )
        self._set(Population(gaussians, first, second, tensors["nodes"].clone()))
        self._pull, self._views = tensors["pull"].clone(), tensors["views"].clone()
        self._generator.set_state(tensors["random"])
        self.iteration, self.seconds = values["iteration"], values["seconds"]
        self._waiting = list(values["waiting"])

    def _set(self, population: Population) -> None:
        """Takes other Gaussians, whose pull is still to be measured."""
        self._population = population
        self._extent = self._extents[population.nodes]
        self._pull, self._views = torch.zeros(len(population)), torch.zeros(len(population))

    def _next_view(self) -> int:
        if not self._waiting:
            self._waiting = torch.randperm(len(self.source), generator=self._generator).tolist()
        return self._waiting.pop()

    def _look(self, target: Target) -> tuple[float, Gaussians]:
        """Loss and gradient; takes the pull on the image into the statistics of density control."""
        leaves = map_attributes(lambda x: x.detach().requires_grad_(), self._population.gaussians)
        with torch.enable_grad():
            scene = SceneGraph(leaves, self._population.nodes, self._actors, self._antialiased)
            moments = Moments.of([target])
            views = (target,) if moments is None else moments.views
            placed = [scene.at(v.frame) for v in views]
            for each_placed in placed:
                each_placed.means.retain_grad()
            splats = [moving(p.activated(), scene, v) for p, v in zip(placed, views, strict=True)]
            images = [render(s, cameras_of([v], self._antialiased)) for s, v in zip(splats, views, strict=True)]
            image = images[0] if moments is None else moments.recorded(in_order(images, range(len(images))))
        plan = plan_loss(self._loss, [target], self.iteration, self._generator, perceptual=False)
        depth = image.depth
        if self._loss.depth > 0:
            with torch.enable_grad():
                depth = image.expected_depth()
        loss, by_color, by_depth = image_gradients(self._loss, image.color, depth, [target], plan)
        if self._loss.depth > 0:
            torch.autograd.backward([image.color, depth], [by_color, by_depth])
        else:
            image.color.backward(by_color)
        self.culled = image.culled
        if self.iteration + 1 < self.table.stop:
            middle = len(views) // 2
            largest, means = splats[middle].scales.detach().amax(1), placed[middle].means.detach()
            pull, seen = screen_pull(means, _summed_gradient(placed), largest, target.chunk_SE3_camera, target.lens)
            self._pull += pull
            self._views += seen
        return loss, map_attributes(lambda x: x.grad, leaves)

    def _move(self, gradient: Gaussians) -> None:
        """Adam in place. Products and sums stand apart: fused ones round differently at the ends of threads' pieces."""
        p, config, t = self._population, self.config, self.iteration
        means = config.means_lr * config.means_lr_end_fraction ** (t / config.iterations)
        rates = (config.log_scales_lr, config.quats_lr, config.logit_opacities_lr, SH_C0 * config.sh_lr)
        root = math.sqrt(1 - SECOND_DECAY ** (t + 1))
        bias = root / (1 - FIRST_DECAY ** (t + 1))
        for f, rate in zip(fields(Gaussians), (means, *rates), strict=True):
            x, m, v, g = (getattr(part, f.name) for part in (p.gaussians, p.first, p.second, gradient))
            m.mul_(FIRST_DECAY).add_(g * (1 - FIRST_DECAY))
            v.mul_(SECOND_DECAY).add_((g * g).mul_(1 - SECOND_DECAY))
            step = v.sqrt().add_(EPSILON * root)
            torch.div(m, step, out=step).mul_(rate * bias)
            x.sub_(step.mul_(self._extent[:, None]) if f.name == "means" else step)

    def _control(self) -> None:
        table, t = self.table, self.iteration
        if t > table.start and t % table.every == 0:
            pull = self._pull / self._views.clamp_min(1)
            self._set(densification.grown(self._population, pull, self._extent, table, self._generator))
            self._set(densification.pruned(self._population, self._extent, table, too_large=t > table.reset_every))
        if t % table.reset_every == 0:
            self._population = densification.reset(self._population, table)


def _summed_gradient(placed: Sequence[Gaussians]) -> Tensor:
    """[N, 3] of the means at all moments of a view; a scene without actors is one and the same at all of them."""
    gradients = [m.grad for m in {id(p.means): p.means for p in placed}.values() if m.grad is not None]
    return gradients[0] if len(gradients) == 1 else torch.stack(gradients).sum(0)


_KINDS = ("gaussians", "first", "second")
