"""The unrolled optimisation (paper Sec. III-C): one loop for GNet, ENet and tuned Adam, for stages and for training."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.auxiliary import NO_AUXILIARY
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.objective import LossAndGradients, Objective
from genre_tasks.optimiser.parameter_groups import GaussianGroup, ParameterGroup, create_auxiliary_groups
from genre_tasks.optimiser.residual_splitting import split_by_residual
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.view_sampler import ViewSampler
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class UnrollSettings:
    """How long an optimisation is, and how many views each iteration renders.

    Attributes:
        iterations: T, the length of the schedule.
        views: source views rendered in each iteration.
        novel_views: fixed novel views rendered in each iteration.
        snapshots: how many intermediate scenes to keep.
        seed: of the order of views and of the perceptual term's crops.
        stage: names the run in errors.
        constrain_ground: Gaussians on the ground move and turn within its plane only.
        fit_deformation: actors' deformation is optimised; otherwise it stays as the scene has it.
        split_fraction: Gaussians to split before the first iteration, as a fraction of their number.
    """

    iterations: int
    views: int
    novel_views: int = 0
    snapshots: int = 0
    seed: int = 0
    stage: str = "optimiser"
    constrain_ground: bool = True
    fit_deformation: bool = True
    split_fraction: float = 0.0

    def snapshot_iterations(self) -> frozenset[int]:
        """Spreads the snapshots evenly over the iterations, without 0 and T.

        >>> sorted(UnrollSettings(24, 6, snapshots=3).snapshot_iterations())
        [6, 12, 18]
        """
        wanted = {round(self.iterations * (i + 1) / (self.snapshots + 1)) for i in range(self.snapshots)}
        return frozenset(wanted - {0, self.iterations})


class UnrolledLoop:
    """An optimisation between two iterations. One iteration is :meth:`evaluate`, then :meth:`advance`.

    Args:
        gaussians: the Gaussians with their step rule.
        auxiliary_groups: the other groups of parameters, which step after the Gaussians.
        samplers: they draw the views of an iteration, in this order.
        objective: the loss.
        generator: it draws the perceptual term's crops; the samplers may share it.
        total: T, the length of the schedule.
        image_residuals: whether gradients shall have image residuals.

    Attributes:
        gaussians: the Gaussians with their step rule.
        samplers: as given.
        total: as given.
    """

    def __init__(
        self,
        gaussians: GaussianGroup,
        auxiliary_groups: Sequence[ParameterGroup],
        samplers: Sequence[ViewSampler],
        objective: Objective,
        generator: torch.Generator,
        total: int,
        image_residuals: bool,
    ) -> None:
        self.gaussians = gaussians
        self.samplers = tuple(samplers)
        self.total = total
        # The Gaussians step first: spherical harmonics shift colours that have moved already.
        self._groups: tuple[ParameterGroup, ...] = (gaussians, *auxiliary_groups)
        self._objective = objective
        self._generator = generator
        self._image_residuals = image_residuals

    @staticmethod
    def start(
        rule: StepRule,
        scene: SceneGraph,
        source: Sequence[Target],
        novel: Sequence[Target],
        objective: Objective,
        settings: UnrollSettings,
    ) -> UnrolledLoop:
        """Sets up an optimisation that starts from a scene, which is split first if the settings ask for it.

        Args:
            rule: how the Gaussians move.
            scene: where the optimisation starts.
            source: source views, at least one.
            novel: fixed novel views; may be empty.
            objective: the loss.
            settings: of the run.

        Returns:
            UnrolledLoop: before its first iteration.
        """
        # One generator for views and crops: the order of all its draws is part of what a seed means.
        generator = torch.Generator().manual_seed(settings.seed)
        samplers = (
            ViewSampler(source, settings.views, generator),
            ViewSampler(novel, settings.novel_views, generator),
        )
        # Before units, bounds and constraints are set up, which are those of the Gaussians that move.
        scene = split_by_residual(scene, [*source, *novel], settings.split_fraction)
        parameterization = Parameterization.from_scene(scene, settings.constrain_ground)
        step_function = rule.prepare(parameterization, mean_camera_center(source))
        gaussians = GaussianGroup(parameterization, step_function)
        auxiliary_groups = create_auxiliary_groups(gaussians, settings.fit_deformation)
        return UnrolledLoop(
            gaussians,
            auxiliary_groups,
            samplers,
            objective=objective,
            generator=generator,
            total=settings.iterations,
            # Residuals cost a part of the backward pass, so only rules that use them get them.
            image_residuals=rule.uses_image_residuals,
        )

    @property
    def iteration(self) -> int:
        """Number of iterations done."""
        return self.gaussians.state.iteration

    @property
    def renders_per_iteration(self) -> int:
        """Number of views that an iteration renders."""
        return sum(sampler.count for sampler in self.samplers)

    def evaluate(self) -> LossAndGradients:
        """Draws the next views, and takes the loss and its gradients at the present parameters.

        Returns:
            LossAndGradients: for :meth:`advance`.
        """
        # Source views before novel ones: the loss does not depend on their order, but the draws do.
        views = [target for sampler in self.samplers for target in sampler.draw()]
        return self.evaluate_views(
            views, self._objective, self.iteration, self._generator, image_residuals=self._image_residuals
        )

    def evaluate_views(
        self,
        views: Sequence[Target],
        objective: Objective,
        iteration: int,
        generator: torch.Generator,
        image_residuals: bool = False,
    ) -> LossAndGradients:
        """Takes any loss of any views at the present parameters; the optimisation does not notice.

        Args:
            views: the batch.
            objective: the loss.
            iteration: as ``Objective.evaluate`` takes it.
            generator: as ``Objective.evaluate`` takes it.
            image_residuals: whether the gradients shall have image residuals.

        Returns:
            LossAndGradients: with respect to all groups.
        """
        # Groups contribute in turn, so that none has to know of the others.
        auxiliary = NO_AUXILIARY
        for group in self._groups:
            auxiliary = group.contribute(auxiliary)
        return objective.evaluate(
            self.gaussians.parameterization,
            self.gaussians.state.offsets,
            views,
            iteration,
            generator,
            auxiliary=auxiliary,
            image_residuals=image_residuals,
        )

    def advance(self, gradients: Gradients) -> None:
        """Takes one step in every group of parameters.

        Args:
            gradients: of :meth:`evaluate`, at the present parameters.
        """
        # Read before the Gaussians step, because their step counts the iteration up.
        iteration = self.iteration
        for group in self._groups:
            group.apply(gradients, iteration, self.total)

    def scene(self) -> SceneGraph:
        """Builds the scene at the present parameters.

        Returns:
            SceneGraph: detached; later iterations do not change it.
        """
        # From the start and not from an earlier scene, so that what is written back does not pile up rounding.
        scene = self.gaussians.parameterization.scene
        for group in self._groups:
            scene = group.write_back(scene)
        return scene


@dataclass(frozen=True)
class UnrollStep:
    """An iteration that was done.

    Attributes:
        iteration: its number, from 1.
        loss: of its views, before the step.
        culled: number of Gaussians that were left out of its renders, by reason.
    """

    iteration: int
    loss: float
    culled: dict[str, int]


def unroll_steps(loop: UnrolledLoop, stage: str) -> Iterator[UnrollStep]:
    """Runs an optimisation iteration by iteration, without end; the caller takes as many as it wants.

    Between two iterations ``loop`` is at rest: ``loop.scene()`` is the scene after the iteration last yielded.

    Args:
        loop: where to go on from.
        stage: names the run in errors.

    Yields:
        UnrollStep: after each iteration. It holds none of the loop's tensors, so that a caller who keeps it does not
        keep their memory.

    Raises:
        NonFiniteError: a gradient or an updated Gaussian is NaN or infinite.
    """
    while True:
        evaluation = loop.evaluate()
        # Checked on both sides of the step, so that the error names the render or the step rule as the cause.
        evaluation.gradients.check_finite(stage)
        loop.advance(evaluation.gradients)
        loop.gaussians.check_finite(stage)
        yield UnrollStep(loop.iteration, evaluation.loss, evaluation.culled)


def unroll(
    rule: StepRule,
    scene: SceneGraph,
    source: Sequence[Target],
    novel: Sequence[Target],
    objective: Objective,
    settings: UnrollSettings,
    progress: Progress = silent,
) -> Reconstruction:
    """Runs T steps of a rule from a scene. The same inputs give the same bytes at any number of threads.

    Args:
        rule: how the Gaussians move.
        scene: where the optimisation starts; an empty one stays empty.
        source: source views, at least one.
        novel: fixed novel views; may be empty.
        objective: the loss.
        settings: of the run.
        progress: called after each iteration.

    Returns:
        Reconstruction: the last scene, and what the settings keep of those before it.

    Raises:
        NonFiniteError: a gradient or an updated Gaussian is NaN or infinite; it names the first such tensor.
        InputError: no view saw any Gaussian.
    """
    loop = UnrolledLoop.start(rule, scene, source, novel, objective, settings)
    snapshot_iterations = settings.snapshot_iterations()
    losses: list[float] = []
    seconds: list[float] = []
    snapshots: dict[int, SceneGraph] = {}
    culled: dict[str, int] = {}
    began = time.perf_counter()
    # T steps of a loop without end: benchmarks follow the same loop past T.
    for step in itertools.islice(unroll_steps(loop, settings.stage), settings.iterations):
        losses.append(step.loss)
        culled = step.culled
        if step.iteration in snapshot_iterations:
            snapshots[step.iteration] = loop.scene()
        seconds.append(time.perf_counter() - began)
        progress(step.iteration, settings.iterations, f"loss {step.loss:.3f}")
        began = time.perf_counter()  # the caller's progress does not count as the iteration's time
    # Without this check a log with wrong poses would return its start, and no word of it.
    visit_count = loop.gaussians.state.visit_count
    if len(visit_count) and settings.iterations and not bool((visit_count > 0).any()):
        raise _out_of_view(len(visit_count), source, settings.stage)
    return Reconstruction(loop.scene(), tuple(losses), snapshots, tuple(seconds), culled)


def mean_camera_center(targets: Sequence[Target]) -> Tensor:
    """Finds the middle of the cameras, which distances are measured from.

    Args:
        targets: at least one view.

    Returns:
        [3] mean camera position in chunk coordinates, float32, on the device of the targets.
    """
    # In float64, as the poses are, and rounded once.
    center = np.mean([target.chunk_SE3_camera[:3, 3] for target in targets], axis=0)
    return torch.as_tensor(center, dtype=torch.float32, device=targets[0].image.pixels.device)


def _out_of_view(count: int, source: Sequence[Target], stage: str) -> InputError:
    cameras = ", ".join(sorted({target.camera for target in source}))
    frames = sorted({target.frame for target in source})
    return InputError(
        f"None of the scene's {count} Gaussians was seen by any view that was drawn of the {len(source)} source views "
        f"(cameras {cameras}, frames {frames[0]}–{frames[-1]})",
        remedy="Check that poses and points are of one log and in metres (genre check), and opacities above 0.",
        stage=stage,
    )
