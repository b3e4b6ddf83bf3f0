"""Scores of a network in training on validation streets, beside tuned Adam's, as a table that grows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flows.training.optimiser_training import psnr, score
from flows.training.recipes import SceneList, scene_recipes
from flows.training.training_scenes import SceneRecipe
from genre_tasks.config import LossConfig
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.losses.rendering_loss import Distance
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.unroll import Plan
from flows.training.curve_table import VALIDATION, read_rows, write_rows

SEEDS = (900, 901, 902)
"""Of validation (configs/seeds.yaml)."""
TABLE = "validation.parquet"


def validation_recipes(scenes: SceneList) -> list[SceneRecipe]:
    """The validation streets at the size of a stage's streets."""
    (like,) = scene_recipes(SceneList(scenes.size, 1), None)
    base, _, query = like.uri.partition("?")
    others = [part for part in query.split("&") if not part.startswith(("seed=", "cameras="))]
    return [replace(like, uri=f"{base}?{'&'.join([f'seed={seed}', *others])}") for seed in SEEDS]


@dataclass
class Validation:
    """Held-out PSNR of the network and of tuned Adam from the same start, with the same views, loss and iterations.

    ``scenes`` makes the validation scenes, when they are first needed. A validation is due at the first checkpoint
    after every ``every`` of all ``steps`` weight updates, and at the end. ``rates`` are tuned Adam's.
    """

    folder: Path
    scenes: Callable[[], Sequence[TrainingScene]]
    loss: LossConfig
    plan: Plan
    rates: tuple[float, ...]
    distance: Distance | None
    every: int
    steps: int
    _made: Sequence[TrainingScene] = ()

    def at_checkpoint(self, done: int, network: LearnedOptimiser) -> None:
        """Adds a row a scene to ``validation.parquet`` where one is due."""
        path = self.folder / TABLE
        rows = [row for row in read_rows(path, VALIDATION) if row["step"] < done]  # more: of a training since deleted
        last = max((row["step"] for row in rows), default=0)
        if done // self.every == last // self.every and done != self.steps:
            return
        self._made = self._made or self.scenes()
        known = {row["scene"]: (row["start_db"], row["adam_db"]) for row in rows}
        for scene in self._made:
            start, adam = known.get(scene.name) or (psnr(scene.scene, scene.heldout), self._heldout(self._adam, scene))
            began = time.perf_counter()
            learned = self._heldout(network, scene)
            seconds = time.perf_counter() - began
            rows.append(
                {"step": done, "scene": scene.name, "start_db": start, "adam_db": adam, "learned_db": learned}
                | {"seconds": seconds}
            )
        write_rows(path, VALIDATION, rows)

    @property
    def _adam(self) -> TunedAdam:
        return TunedAdam(self.rates)

    def _heldout(self, rule: StepRule, scene: TrainingScene) -> float:
        return score(rule, scene, self.loss, self.plan, self.distance).heldout
