"""The unrolled optimisation (paper Sec. III-C): one loop for GNet, ENet and tuned Adam."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.errors import InputError
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.differentiable_render import Beside
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.residual_splitting import split_where_images_have_more
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import StepRule, schedule
from genre_tasks.optimiser.view_sampler import ViewSampler
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction

if TYPE_CHECKING:
    from genre_tasks.optimiser.deformation_optimiser import DeformationFit
    from genre_tasks.optimiser.sh_optimiser import GlossState


@dataclass(frozen=True)
class Plan:
    """How far and how often to look: ``iterations`` T, views drawn in each, snapshots kept on the way, the seed.

    ``stage`` names the run in errors; ``constrain_ground``: see ``Frame.of``; ``deform``: how actors deform is fitted,
    else it stays as the scene has it; ``split``: so many more Gaussians, per those there are, before the first
    iteration, see ``splitting``.
    """

    iterations: int
    views: int
    novel_views: int = 0
    snapshots: int = 0
    seed: int = 0
    stage: str = "optimiser"
    constrain_ground: bool = True
    deform: bool = True
    split: float = 0.0

    def snapshot_iterations(self) -> frozenset[int]:
        """Evenly spaced, without 0 and T."""
        wanted = {round(self.iterations * (i + 1) / (self.snapshots + 1)) for i in range(self.snapshots)}
        return frozenset(wanted - {0, self.iterations})


def unroll(
    rule: StepRule,
    scene: SceneGraph,
    source: Sequence[Target],
    novel: Sequence[Target],
    objective: Objective,
    plan: Plan,
    progress: Progress = silent,
) -> Reconstruction:
    """Runs ``plan.iterations`` steps of ``rule`` from ``scene``.

    In each, ``plan.views`` of ``source`` and ``plan.novel_views`` of ``novel`` are rendered, drawn with the plan's
    seed; before them the scene is split as the plan says. The same inputs give the same bytes at any thread count. An
    empty scene stays empty. Raises ``NonFiniteError`` naming the first tensor that is not finite, ``InputError`` where
    no view saw any Gaussian.
    """
    generator = torch.Generator().manual_seed(plan.seed)
    samplers = [ViewSampler(source, plan.views, generator), ViewSampler(novel, plan.novel_views, generator)]
    scene = split_where_images_have_more(scene, [*source, *novel], plan.split)
    frame = Frame.of(scene, plan.constrain_ground)
    state = State.start(len(scene), scene.gaussians.means)
    gloss = _gloss_of(scene)
    step = rule.start(frame, camera_centre(source))
    fit = _deforming(scene) if plan.deform else None
    keep = plan.snapshot_iterations()
    losses, seconds, snapshots, culled = [], [], {}, {}
    for i in range(plan.iterations):
        began = time.perf_counter()
        batch = [t for s in samplers for t in s.draw()]
        deformation = scene.deformation if fit is None else fit.deformation
        beside = Beside(deformation, None if gloss is None else gloss.harmonics)
        sight = objective(frame, state.offsets, batch, i, generator, beside, rule.residuals)
        check_finite(sight.gradient, "gradient", plan.stage)
        state = state.saw(sight.gradient, sight.residuals)
        state = state.moved(frame, step(state, sight.gradient, plan.iterations))
        check_finite(state.offsets, "updated Gaussians", plan.stage)
        if fit is not None and sight.by_deformation is not None:
            check_finite(sight.by_deformation, "gradient of the deformation", plan.stage)
            fit.step(sight.by_deformation, i, plan.iterations)
        if gloss is not None and sight.gloss is not None:
            check_finite(sight.gloss.gradient, "gradient in harmonics", plan.stage)
            gloss, shift = gloss.moved(sight.gloss, sight.gradient[:, 11:14], schedule(i, plan.iterations))
            state = state.recoloured(shift)
        losses.append(sight.loss)
        culled = sight.culled
        if i + 1 in keep:
            snapshots[i + 1] = _with(fit, moved_scene(frame, state, gloss))
        seconds.append(time.perf_counter() - began)
        progress(i + 1, plan.iterations, f"loss {sight.loss:.3f}")
    if len(scene) and plan.iterations and not bool((state.seen > 0).any()):
        raise _out_of_view(len(scene), source, plan.stage)
    return Reconstruction(
        _with(fit, moved_scene(frame, state, gloss)), tuple(losses), snapshots, tuple(seconds), culled
    )


def _deforming(scene: SceneGraph) -> DeformationFit | None:
    """What fits the offsets of a scene whose actors deform."""
    if scene.deformation is None:
        return None
    from genre_tasks.optimiser.deformation_optimiser import DeformationFit

    return DeformationFit(scene.deformation)


def _with(fit: DeformationFit | None, scene: SceneGraph) -> SceneGraph:
    return scene if fit is None else replace(scene, deformation=fit.deformation)


def _out_of_view(count: int, source: Sequence[Target], stage: str) -> InputError:
    cameras = ", ".join(sorted({t.camera for t in source}))
    frames = sorted({t.frame for t in source})
    return InputError(
        f"None of the scene's {count} Gaussians was seen by any view that was drawn of the {len(source)} source views "
        f"(cameras {cameras}, frames {frames[0]}–{frames[-1]})",
        remedy="Check that poses and points are of one log and in metres (genre check), and opacities above 0.",
        stage=stage,
    )


def camera_centre(targets: Sequence[Target]) -> Tensor:
    """Mean camera position [3] in chunk coordinates, on the device of the targets."""
    centre = np.mean([t.chunk_SE3_camera[:3, 3] for t in targets], axis=0)
    return torch.as_tensor(centre, dtype=torch.float32, device=targets[0].image.image.device)


def _gloss_of(scene: SceneGraph) -> GlossState | None:
    """What harmonics need, where the scene has any."""
    if scene.harmonics is None:
        return None
    from genre_tasks.optimiser.sh_optimiser import GlossState

    return GlossState.start(scene.harmonics)


def moved_scene(frame: Frame, state: State, gloss: GlossState | None = None) -> SceneGraph:
    """The scene at the state, detached; with the harmonics of ``gloss``, or those that it has had all along."""
    packed = frame.gaussians(state.offsets).packed().detach()
    moved = frame.scene.with_gaussians(type(frame.scene.gaussians).unpacked(packed))
    return moved if gloss is None else moved.with_harmonics(gloss.harmonics)
