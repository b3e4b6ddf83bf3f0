"""Episodes of meta-training: one scene somewhere along its unrolled optimisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.learned.features import StaticFeatures, compute_features
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.ground_constraint import project_onto_ground
from genre_tasks.optimiser.objective import LossAndGradients, Objective
from genre_tasks.optimiser.parameter_groups import GaussianGroup
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepFunction
from genre_tasks.optimiser.unroll import UnrolledLoop, mean_camera_center
from genre_tasks.optimiser.view_sampler import ViewSampler
from genre_tasks.scene.graph import SceneGraph


@dataclass(frozen=True)
class TrainingScene:
    """A start, and the images that it is optimised towards and measured with.

    Attributes:
        name: for records.
        scene: where the optimisation starts.
        source: source views, which the optimiser sees.
        heldout: views of the log that only the held-out loss sees.
        fixed: fixed novel views, which the optimiser sees; may be empty.
        truth: images at novel views that the held-out loss sees; may be empty. Of a street they are true, and the
            optimiser sees none of them but through stand-ins, which are made of every other one. Of a real log they
            are the images in ``fixed``, which the optimiser sees too.
    """

    name: str
    scene: SceneGraph
    source: tuple[Target, ...]
    heldout: tuple[Target, ...]
    fixed: tuple[Target, ...] = ()
    truth: tuple[Target, ...] = ()


@dataclass(frozen=True)
class EpisodeConfig:
    """How an episode goes.

    Attributes:
        scene: index of the training scene.
        iterations: T, the length of the schedule.
        views: source views in each iteration.
        novel_views: fixed novel views in each iteration.
        log_scale_shift: added to all log-scales at the start.
        logit_shift: added to all logit opacities at the start.
        held_out_views: held-out views, and as many true novel views, in each held-out loss.
    """

    scene: int
    iterations: int
    views: int
    novel_views: int
    log_scale_shift: float
    logit_shift: float
    held_out_views: int = 3


@dataclass
class Episode:
    """A scene between two iterations of its optimisation.

    Attributes:
        config: how the episode goes.
        loop: the optimisation.
        static_features: of its Gaussians.
        pyramid: voxels of its Gaussians.
        held_out_samplers: they draw the views of the held-out loss.
        evaluation: loss and gradients at the present state, for the next step; ``None`` until they are taken.
    """

    config: EpisodeConfig
    loop: UnrolledLoop
    static_features: StaticFeatures
    pyramid: VoxelPyramid
    held_out_samplers: tuple[ViewSampler, ...]
    evaluation: LossAndGradients | None = None

    @staticmethod
    def start(
        config: EpisodeConfig,
        scene: TrainingScene,
        network: LearnedOptimiser,
        objective: Objective,
        generator: torch.Generator,
    ) -> Episode:
        """Sets an episode up before its first iteration.

        Args:
            config: how it goes.
            scene: the start and its images.
            network: in training; its present weights make the steps until :meth:`use_network` or
                :meth:`record_steps` is called.
            objective: the loss that the optimiser sees.
            generator: it draws views and crops, for as long as the episode lasts.

        Returns:
            Episode: at iteration 0.
        """
        # Units and bounds are those of the perturbed start, as they would be of a scene that looks so.
        parameterization = Parameterization.from_scene(perturb_start(scene.scene, config))
        center = mean_camera_center(scene.source)
        pyramid = network.pyramid(parameterization, center)
        static_features = StaticFeatures.compute(parameterization, center)
        step_function = _inference_step(network, parameterization, static_features, pyramid)
        samplers = (
            ViewSampler(scene.source, config.views, generator),
            ViewSampler(scene.fixed, config.novel_views, generator),
        )
        held_out_samplers = (
            ViewSampler(scene.heldout, config.held_out_views, generator),
            ViewSampler(scene.truth, config.held_out_views, generator),
        )
        loop = UnrolledLoop(
            # Gaussians alone are trained on; what else a scene has is neither rendered nor moved.
            GaussianGroup(parameterization, step_function),
            (),
            samplers,
            objective=objective,
            generator=generator,
            total=config.iterations,
            image_residuals=network.uses_image_residuals,
        )
        return Episode(config, loop, static_features, pyramid, held_out_samplers)

    @property
    def parameterization(self) -> Parameterization:
        """The scene at its start, and the units of the offsets."""
        return self.loop.gaussians.parameterization

    @property
    def state(self) -> State:
        """Offsets and moments after the steps so far."""
        return self.loop.gaussians.state

    @property
    def samplers(self) -> tuple[ViewSampler, ...]:
        """All samplers: of the source, fixed, held-out and true views."""
        # In this order checkpoints store the queues.
        return (*self.loop.samplers, *self.held_out_samplers)

    def evaluate_heldout(self, objective: Objective, generator: torch.Generator) -> LossAndGradients:
        """Takes the loss and its gradients on held-out views and on the novel views in ``truth``.

        Args:
            objective: the held-out loss.
            generator: it draws the perceptual term's crops.

        Returns:
            LossAndGradients: at the present offsets.
        """
        views = [target for sampler in self.held_out_samplers for target in sampler.draw()]
        # As iteration 0, in which the perceptual term is always taken.
        return self.loop.evaluate_views(views, objective, 0, generator)

    def use_network(self, network: LearnedOptimiser) -> None:
        """Makes the next steps with the network's weights as they are now, without gradients."""
        self.loop.gaussians.step_function = _inference_step(
            network, self.parameterization, self.static_features, self.pyramid
        )

    def record_steps(self, network: LearnedOptimiser, rows: Tensor) -> RecordedSteps:
        """Makes the next steps with the network's weights as they are now, and records them differentiably.

        Args:
            network: in training.
            rows: [M] Gaussians whose steps are recorded.

        Returns:
            RecordedSteps: it fills up while the loop advances.
        """
        self.use_network(network)
        recorded = RecordedSteps(self, network, rows)
        self.loop.gaussians.step_function = recorded
        return recorded


class RecordedSteps:
    """A step function that moves as inference does, and keeps each step with its gradient in the network's weights.

    Args:
        episode: with the step function that makes the moves.
        network: in training.
        rows: [M] Gaussians whose steps are kept.

    Attributes:
        deltas: [M, 14] of each step so far, without what leads out of the ground's planes, as the state is moved.
    """

    def __init__(self, episode: Episode, network: LearnedOptimiser, rows: Tensor) -> None:
        self.deltas: list[Tensor] = []
        self._episode = episode
        self._network = network
        self._rows = rows
        self._inference_step = episode.loop.gaussians.step_function

    def __call__(self, state: State, gradient: Tensor, total: int) -> Tensor:
        """Computes a step without gradient [N, 14], and keeps its differentiable rows; see :class:`StepFunction`."""
        episode = self._episode
        parameterization = episode.parameterization
        # Detached features (paper Sec. III-C): the graph holds the network alone, for the sampled rows alone.
        inputs = compute_features(parameterization, episode.static_features, state, gradient, total)
        delta = self._network.sampled_delta(state, inputs, episode.pyramid, total, self._rows)
        # The constraint is part of the step: a gradient out of the plane would train what the state never does.
        self.deltas.append(project_onto_ground(delta, parameterization.ground_constraint[self._rows]))
        # The move is made as at inference, by the kernel where there is one, so that training meets the same states.
        return self._inference_step(state, gradient, total)


def perturb_start(scene: SceneGraph, config: EpisodeConfig) -> SceneGraph:
    """Changes all sizes and all opacities alike, so that training meets starts of many kinds.

    Args:
        scene: a training scene.
        config: the shifts of log-scales and logit opacities.

    Returns:
        SceneGraph: the start of the episode.
    """
    gaussians = scene.gaussians
    return scene.with_gaussians(
        replace(
            gaussians,
            log_scales=gaussians.log_scales + config.log_scale_shift,
            logit_opacities=gaussians.logit_opacities + config.logit_shift,
        )
    )


def _inference_step(
    network: LearnedOptimiser,
    parameterization: Parameterization,
    static_features: StaticFeatures,
    pyramid: VoxelPyramid,
) -> StepFunction:
    # The weights are copied into the kernel's layout; the graph must not follow them there.
    with torch.no_grad():
        return network.create_step_function(parameterization, static_features, pyramid)
