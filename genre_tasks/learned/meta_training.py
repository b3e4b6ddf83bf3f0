"""Meta-training of the learned optimiser on many scenes (paper Sec. III-C, III-D).

The training loss is taken after every iteration and differentiated through the steps only: ∇G is detached. The gradient
of the rendering loss at G_{j+1}, which the next step needs anyway, is the derivative of that loss with respect to each
earlier step; a segment of K steps adds one loss on views that the optimiser does not see. Each loss is divided by its
value, so that a dark and a bright street count alike. A pool holds scenes at staggered ages.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from genre_tasks.config import LossConfig, Section
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import Course, Episode, TrainingScene
from genre_tasks.losses.rendering_loss import Distance
from genre_tasks.optimiser.objective import Objective, Sight


class MetaConfig(Section):
    """Settings of meta-training; ``steps`` weight updates in all.

    ``sample``: the share of a scene's Gaussians, drawn anew for each update, through which the gradient is taken.
    """

    steps: int = 1000
    segment: int = 6
    sample: float = 1.0
    pool: int = 4
    iterations: tuple[int, ...] = (12, 24, 24, 36)
    views: tuple[int, ...] = (4, 6, 6, 8)
    novel_views: int = 0
    rate: float = 3e-3
    warm_up: int = 30
    clip: float = 0.3
    judged: float = 1.0
    judges: int = 3
    log_scale_spread: float = 0.15
    logit_spread: float = 0.3
    loss: LossConfig = LossConfig()
    judge_loss: LossConfig = LossConfig()
    seed: int = 0


@dataclass(frozen=True)
class StepRecord:
    """One weight update: the unseen views' loss at the segment's end, the gradient's norm, the episode's age."""

    step: int
    scene: str
    iteration: int
    seen_loss: float
    judged_loss: float
    gradient_norm: float


class MetaTraining:
    """The training's whole state; ``step`` advances it by one weight update.

    Everything random comes from ``generator``; see ``flows.training.checkpoint`` for saving and resuming.
    """

    def __init__(
        self,
        network: LearnedOptimiser,
        scenes: Sequence[TrainingScene],
        config: MetaConfig,
        distance: Distance | None = None,
    ) -> None:
        self.network, self.scenes, self.config = network.train().requires_grad_(True), tuple(scenes), config
        self.generator = torch.Generator().manual_seed(config.seed)
        self.optimiser = torch.optim.Adam(network.parameters(), lr=config.rate, betas=(0.9, 0.95))
        self.seen, self.unseen = Objective(config.loss, distance), Objective(config.judge_loss, distance)
        self.pool: list[Episode] = []
        self.done = 0

    def step(self) -> StepRecord:
        """Advances the next episode of the pool by a segment and updates the weights once."""
        if not self.pool:
            self._fill()
        place = self.done % self.config.pool
        episode = self.pool[place]
        if episode.sight is None:
            episode.sight = self._look(episode)
        objective, seen_loss, judged_loss = self._segment(episode)
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate()
        self.optimiser.zero_grad()
        objective.backward()
        norm = float(nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip))
        if math.isfinite(norm):
            self.optimiser.step()
        scene = self.scenes[episode.course.scene].name
        record = StepRecord(self.done, scene, episode.state.iteration, seen_loss, judged_loss, norm)
        self.done += 1
        finite = bool(torch.isfinite(episode.state.offsets).all()) and math.isfinite(norm)
        if episode.state.iteration >= episode.course.iterations or not finite:
            self.pool[place] = self._fresh()
        return record

    def _segment(self, episode: Episode) -> tuple[Tensor, float, float]:
        """K steps; the sum over steps of step · gradient of all later losses, whose derivative is the meta-gradient."""
        deltas: list[Tensor] = []
        gradients: list[Tensor] = []
        count = len(episode.frame.scene)
        rows = torch.randperm(count, generator=self.generator)[: max(1, round(self.config.sample * count))]
        rows = rows.to(episode.state.offsets.device)
        move = episode.mover(self.network)
        for _ in range(self.config.segment):
            deltas.append(episode.step(self.network, move, rows))
            episode.sight = self._look(episode)
            gradients.append(episode.sight.gradient[rows] / (episode.sight.loss * self.config.segment))
        judged = episode.judge(self.unseen, self.generator)
        later = self.config.judged * judged.gradient[rows] / judged.loss
        total = deltas[0].new_zeros(())
        for delta, gradient in zip(reversed(deltas), reversed(gradients), strict=True):
            later = later + gradient
            total = total + (delta * later).sum() * (count / len(rows))
        return total, episode.sight.loss, judged.loss  # type: ignore[union-attr]

    def _look(self, episode: Episode) -> Sight:
        return episode.look(self.seen, self.generator, self.network.residuals)

    def _fill(self) -> None:
        """A pool at random ages, so that early and late iterations are trained from the start."""
        for _ in range(self.config.pool):
            episode = self._fresh()
            move = episode.mover(self.network)
            for _ in range(self._below(episode.course.iterations)):
                episode.sight = self._look(episode)
                episode.step_only(move)
            episode.sight = None
            self.pool.append(episode)

    def _fresh(self) -> Episode:
        config = self.config
        scene = self._below(len(self.scenes))
        spread = torch.randn(2, generator=self.generator).tolist()
        course = Course(
            scene,
            config.iterations[self._below(len(config.iterations))],
            config.views[self._below(len(config.views))],
            config.novel_views,
            config.log_scale_spread * spread[0],
            config.logit_spread * spread[1],
            config.judges,
        )
        return Episode.start(course, self.scenes[scene], self.network, self.generator)

    def _rate(self) -> float:
        """Linear warm-up, then a cosine down to a twentieth."""
        part = self.done / self.config.steps
        cosine = 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * min(part, 1.0)))
        return self.config.rate * min(1.0, (self.done + 1) / self.config.warm_up) * cosine

    def _below(self, limit: int) -> int:
        return int(torch.randint(limit, (1,), generator=self.generator))
