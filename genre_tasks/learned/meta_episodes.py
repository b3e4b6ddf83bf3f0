"""Episodes of meta-training: one scene somewhere along its unrolled optimisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from genre_tasks.learned.features import Fixed, features
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.ground_constraint import along_ground
from genre_tasks.optimiser.objective import Objective, Sight
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import Step
from genre_tasks.optimiser.unroll import camera_centre
from genre_tasks.optimiser.view_sampler import ViewSampler
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class TrainingScene:
    """A start and what it is optimised towards.

    ``source`` and ``fixed`` are what the optimiser sees; ``heldout`` and ``truth`` (true or fixed images at the novel
    views) judge it in training alone. ``fixed`` and ``truth`` may be empty.
    """

    name: str
    scene: SceneGraph
    source: tuple[Target, ...]
    heldout: tuple[Target, ...]
    fixed: tuple[Target, ...] = ()
    truth: tuple[Target, ...] = ()


@dataclass(frozen=True)
class Course:
    """How an episode goes: which scene, T, views in each iteration, and the start's change of size and opacity.

    ``judges``: held-out views, and as many true novel views, in each judgement.
    """

    scene: int
    iterations: int
    views: int
    novel_views: int
    log_scale_shift: float
    logit_shift: float
    judges: int = 3


@dataclass
class Episode:
    """A scene at iteration ``state.iteration`` of its course, with the gradient there already taken."""

    course: Course
    frame: Frame
    pyramid: VoxelPyramid
    columns: Fixed
    samplers: tuple[ViewSampler, ...]
    state: State
    sight: Sight | None = None

    @staticmethod
    def start(course: Course, scene: TrainingScene, network: LearnedOptimiser, generator: torch.Generator) -> Episode:
        """At iteration 0."""
        frame = Frame.of(shifted(scene.scene, course))
        centre = camera_centre(scene.source)
        samplers = (
            ViewSampler(scene.source, course.views, generator),
            ViewSampler(scene.fixed, course.novel_views, generator),
            ViewSampler(scene.heldout, course.judges, generator),
            ViewSampler(scene.truth, course.judges, generator),
        )
        state = State.start(len(scene.scene), scene.scene.gaussians.means)
        return Episode(course, frame, network.pyramid(frame, centre), Fixed.of(frame, centre), samplers, state)

    def look(self, objective: Objective, generator: torch.Generator, residuals: bool = False) -> Sight:
        """Loss and gradient at the present offsets, on the next views that the optimiser may see; with residuals."""
        batch = [*self.samplers[0].draw(), *self.samplers[1].draw()]
        at = self.frame, self.state.offsets, batch, self.state.iteration
        return objective(*at, generator, residuals=residuals)

    def judge(self, objective: Objective, generator: torch.Generator) -> Sight:
        """Loss and gradient at the present offsets, on views that the optimiser does not see."""
        batch = [*self.samplers[2].draw(), *self.samplers[3].draw()]
        return objective(self.frame, self.state.offsets, batch, 0, generator)

    def step(self, network: LearnedOptimiser, move: Step, rows: torch.Tensor) -> torch.Tensor:
        """Moves the state by ``move`` (see :meth:`mover`); returns the rows [M, 14] of the step with their gradient.

        Without what leads out of the ground's planes, as the state is moved.
        """
        inputs, total = self._see(), self.course.iterations
        delta = network.sampled_delta(self.state, inputs, self.pyramid, total, rows)
        self._move(move)
        return along_ground(delta, self.frame.planes[rows])

    def step_only(self, move: Step) -> None:
        """As :meth:`step`, without a gradient."""
        assert self.sight is not None
        self.state = self.state.saw(self.sight.gradient, self.sight.residuals)
        self._move(move)

    def mover(self, network: LearnedOptimiser) -> Step:
        """The network's step without gradient, with its weights as they are now."""
        with torch.no_grad():
            return network.step_of(self.frame, self.columns, self.pyramid)

    def _see(self) -> torch.Tensor:
        assert self.sight is not None
        self.state = self.state.saw(self.sight.gradient, self.sight.residuals)
        return features(self.frame, self.columns, self.state, self.sight.gradient, self.course.iterations)

    def _move(self, move: Step) -> None:
        assert self.sight is not None
        self.state = self.state.moved(self.frame, move(self.state, self.sight.gradient, self.course.iterations))


def shifted(scene: SceneGraph, course: Course) -> SceneGraph:
    """The scene with all sizes and opacities changed alike, so that training meets starts of many kinds."""
    g: Gaussians = scene.gaussians
    return scene.with_gaussians(
        replace(
            g,
            log_scales=g.log_scales + course.log_scale_shift,
            logit_opacities=g.logit_opacities + course.logit_shift,
        )
    )
