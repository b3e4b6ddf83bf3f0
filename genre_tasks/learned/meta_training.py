"""Meta-training of the learned optimiser on many scenes (paper Sec. III-C, III-D).

The training loss is taken after every iteration and differentiated through the steps only: the gradient of the
rendering loss enters the network detached. The gradient at iteration j + 1, which the next step needs anyway, is the
derivative of that iteration's loss with respect to each earlier step. A segment of K steps adds one held-out loss, on
views that the optimiser does not see. Each loss is divided by its value, so that a dark and a bright street count
alike. A pool holds scenes at staggered ages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import ConfigDict, Field
from torch import Tensor, nn

from genre_tasks.config import LossConfig, Section
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import Episode, EpisodeConfig, TrainingScene
from genre_tasks.losses.rendering_loss import ImageDistance
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import cosine_decay


class MetaConfig(Section):
    """Settings of meta-training. Checkpoints store some of them under older names, the aliases.

    Attributes:
        steps: weight updates in all.
        segment: K, iterations of an episode for each update.
        sample: fraction of a scene's Gaussians through which the gradient is taken, drawn for each update.
        pool: number of episodes that are under way at a time.
        iterations: lengths T of episodes, to draw from.
        views: source views of an iteration, to draw from.
        novel_views: fixed novel views of an iteration.
        learning_rate: of Adam on the weights, at its largest.
        warm_up: updates over which the learning rate rises.
        clip: largest norm of the weights' gradient.
        held_out_weight: of the held-out loss, against the loss after each iteration.
        held_out_views: held-out views, and as many true novel views, in each held-out loss.
        log_scale_spread: standard deviation of the change of all sizes at the start of an episode.
        logit_spread: standard deviation of the change of all opacities there.
        loss: that the optimiser sees.
        held_out_loss: on views that it does not see.
        seed: of everything random.
    """

    model_config = ConfigDict(serialize_by_alias=True, validate_by_alias=True, validate_by_name=True)

    steps: int = 1000
    segment: int = 6
    sample: float = 1.0
    pool: int = 4
    iterations: tuple[int, ...] = (12, 24, 24, 36)
    views: tuple[int, ...] = (4, 6, 6, 8)
    novel_views: int = 0
    # The aliases are the names in checkpoints, and must stay for old ones to resume.
    learning_rate: float = Field(3e-3, alias="rate")
    warm_up: int = 30
    clip: float = 0.3
    held_out_weight: float = Field(1.0, alias="judged")
    held_out_views: int = Field(3, alias="judges")
    log_scale_spread: float = 0.15
    logit_spread: float = 0.3
    loss: LossConfig = LossConfig()
    held_out_loss: LossConfig = Field(LossConfig(), alias="judge_loss")
    seed: int = 0


@dataclass(frozen=True)
class StepRecord:
    """What is known of one weight update.

    Attributes:
        step: updates before this one.
        scene: name of the training scene.
        iteration: the episode's iteration after this update's segment.
        training_loss: on views that the optimiser sees, at the segment's end.
        held_out_loss: on views that it does not see, at the segment's end.
        gradient_norm: of the weights' gradient, before it is clipped.
    """

    step: int
    scene: str
    iteration: int
    training_loss: float
    held_out_loss: float
    gradient_norm: float

    def as_row(self) -> dict[str, Any]:
        """Names the values as the columns of a learning curve.

        Returns:
            Column name → value, without ``seconds``.

        >>> list(StepRecord(0, "street", 6, 0.2, 0.3, 0.1).as_row())
        ['step', 'scene', 'iteration', 'seen_loss', 'judged_loss', 'gradient_norm']
        """
        return {
            "step": self.step,
            "scene": self.scene,
            "iteration": self.iteration,
            "seen_loss": self.training_loss,
            "judged_loss": self.held_out_loss,
            "gradient_norm": self.gradient_norm,
        }


@dataclass(frozen=True)
class _Segment:
    """K steps of an episode: a scalar whose derivative is the meta-gradient, and the losses at the end."""

    meta_loss: Tensor
    training_loss: float
    held_out_loss: float


class MetaTraining:
    """The training's state. Everything random comes from one generator.

    Args:
        network: to train, in place.
        scenes: training scenes.
        config: settings.
        distance: the perceptual distance, where a loss has a term for it.

    Attributes:
        network: in training mode.
        scenes: as given.
        config: as given.
        generator: of everything random.
        optimiser: of the weights.
        pool: episodes under way; empty before the first update.
        done: number of updates so far.
    """

    def __init__(
        self,
        network: LearnedOptimiser,
        scenes: Sequence[TrainingScene],
        config: MetaConfig,
        distance: ImageDistance | None = None,
    ) -> None:
        self.network = network.train().requires_grad_(True)
        self.scenes = tuple(scenes)
        self.config = config
        # One generator for episodes, views, crops and sampled rows: its state is all that a checkpoint needs of chance.
        self.generator = torch.Generator().manual_seed(config.seed)
        # β₂ below Adam's usual 0.999, which would remember more updates than a training has.
        self.optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate, betas=(0.9, 0.95))
        self.objective = Objective(config.loss, distance)
        self.held_out_objective = Objective(config.held_out_loss, distance)
        self.pool: list[Episode] = []
        self.done = 0

    def step(self) -> StepRecord:
        """Advances the next episode of the pool by a segment, and updates the weights once.

        Returns:
            StepRecord: of this update. An update whose gradient is not finite leaves the weights as they are, and its
            episode is replaced.
        """
        if not self.pool:
            self._fill_pool()
        # Episodes take turns, so that successive updates see unlike scenes and ages.
        slot = self.done % self.config.pool
        episode = self.pool[slot]
        segment = self._run_segment(episode)
        gradient_norm = self._update_weights(segment.meta_loss)
        record = StepRecord(
            self.done,
            self.scenes[episode.config.scene].name,
            episode.state.iteration,
            training_loss=segment.training_loss,
            held_out_loss=segment.held_out_loss,
            gradient_norm=gradient_norm,
        )
        self.done += 1
        # NaN in the offsets never goes away again: such an episode is given up.
        is_finite = bool(torch.isfinite(episode.state.offsets).all()) and math.isfinite(gradient_norm)
        if episode.state.iteration >= episode.config.iterations or not is_finite:
            self.pool[slot] = self.start_episode(self._draw_episode_config())
        return record

    def start_episode(self, config: EpisodeConfig) -> Episode:
        """Sets up an episode of this training.

        Args:
            config: how it goes.

        Returns:
            Episode: at iteration 0, with this training's network, loss and generator.
        """
        return Episode.start(config, self.scenes[config.scene], self.network, self.objective, self.generator)

    def _run_segment(self, episode: Episode) -> _Segment:
        """Makes K steps; the meta-loss sums step · gradient of all later losses, over the steps."""
        config = self.config
        evaluation = episode.loop.evaluate() if episode.evaluation is None else episode.evaluation
        count = len(episode.state.offsets)
        sample_count = max(1, round(config.sample * count))
        rows = torch.randperm(count, generator=self.generator)[:sample_count].to(episode.state.offsets.device)
        # Other rows for each update: the memory of a segment's graph grows with them.
        recorded = episode.record_steps(self.network, rows)
        later_gradients: list[Tensor] = []
        for _ in range(config.segment):
            # No check for finite values: an episode that diverges is replaced, and the training goes on.
            episode.loop.advance(evaluation.gradients)
            evaluation = episode.loop.evaluate()
            # Over the loss, so that a dark and a bright street count alike; over K, so that the meta-gradient's size
            # does not grow with the length of a segment.
            later_gradients.append(evaluation.gradients.gaussians[rows] / (evaluation.loss * config.segment))
        episode.evaluation = evaluation
        held_out = episode.evaluate_heldout(self.held_out_objective, self.generator)
        # From the last step back, ``later`` gathers the gradients of all losses that come after a step.
        later = config.held_out_weight * held_out.gradients.gaussians[rows] / held_out.loss
        meta_loss = recorded.deltas[0].new_zeros(())
        for delta, gradient in zip(reversed(recorded.deltas), reversed(later_gradients), strict=True):
            later = later + gradient
            # N / M makes the sum over sampled rows an unbiased estimate of the sum over all.
            meta_loss = meta_loss + (delta * later).sum() * (count / len(rows))
        return _Segment(meta_loss, evaluation.loss, held_out.loss)

    def _update_weights(self, meta_loss: Tensor) -> float:
        """Takes one step of Adam, unless the gradient is not finite; returns the gradient's norm."""
        # Set by hand instead of by a scheduler: a checkpoint then needs the number of updates and nothing else.
        for group in self.optimiser.param_groups:
            group["lr"] = self._learning_rate()
        self.optimiser.zero_grad()
        meta_loss.backward()
        norm = float(nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip))
        # One bad episode must not ruin the weights; its update is left out.
        if math.isfinite(norm):
            self.optimiser.step()
        return norm

    def _fill_pool(self) -> None:
        """Starts episodes and lets them age by chance, so that early and late iterations are trained at once."""
        for _ in range(self.config.pool):
            episode = self.start_episode(self._draw_episode_config())
            for _ in range(self._draw_below(episode.config.iterations)):
                # Without recording: there is no update to make yet.
                evaluation = episode.loop.evaluate()
                episode.loop.advance(evaluation.gradients)
            self.pool.append(episode)

    def _draw_episode_config(self) -> EpisodeConfig:
        config = self.config
        # The order of these draws is part of what a seed means.
        scene = self._draw_below(len(self.scenes))
        log_scale_change, logit_change = torch.randn(2, generator=self.generator).tolist()
        iterations = config.iterations[self._draw_below(len(config.iterations))]
        views = config.views[self._draw_below(len(config.views))]
        return EpisodeConfig(
            scene,
            iterations,
            views,
            config.novel_views,
            log_scale_shift=config.log_scale_spread * log_scale_change,
            logit_shift=config.logit_spread * logit_change,
            held_out_views=config.held_out_views,
        )

    def _learning_rate(self) -> float:
        """Rises linearly, then falls along a cosine to a twentieth."""
        warm_up = min(1.0, (self.done + 1) / self.config.warm_up)
        return self.config.learning_rate * warm_up * cosine_decay(self.done, self.config.steps)

    def _draw_below(self, limit: int) -> int:
        return int(torch.randint(limit, (1,), generator=self.generator))
