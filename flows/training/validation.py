"""Scores of a network in training on validation streets, and tuned Adam's to compare, as a table that grows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flows.training.curve_table import VALIDATION_SCORES, load_rows, save_rows
from flows.training.optimiser_training import mean_psnr, score_rule
from flows.training.scene_lists import SceneList, list_scene_recipes
from flows.training.training_scenes import SceneRecipe
from genre_tasks.config import LearningRates, LossConfig
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.losses.rendering_loss import ImageDistance
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings

SEEDS = (900, 901, 902)
"""Seeds of validation (configs/seeds.yaml)."""

SCORES_FILE = "validation.parquet"


def list_validation_recipes(scenes: SceneList) -> list[SceneRecipe]:
    """Lists the validation streets at the size of a stage's streets.

    Args:
        scenes: the stage's scenes.

    Returns:
        A scene for each of :data:`SEEDS`.
    """
    # A street of the stage's own list, so that validation has the same size and number of Gaussians.
    (street,) = list_scene_recipes(SceneList(scenes.size, 1), None)
    base, _, query = street.uri.partition("?")
    # Without the number of cameras: all validation streets have the usual rig.
    others = [part for part in query.split("&") if not part.startswith(("seed=", "cameras="))]
    return [replace(street, uri=f"{base}?{'&'.join([f'seed={seed}', *others])}") for seed in SEEDS]


@dataclass
class Validation:
    """Held-out PSNR of the network and of tuned Adam from the same start, with the same views, loss and iterations.

    A validation is due at the first checkpoint after every ``every`` weight updates, and at the end.

    Attributes:
        folder: where the table is written.
        load_scenes: loads the validation scenes, when they are first needed.
        loss: what both descend.
        plan: views and iterations of both.
        adam_learning_rates: tuned Adam's learning rates, by attribute of the Gaussians.
        distance: perceptual distance, for a loss with such a term.
        every: weight updates between validations.
        steps: weight updates of the training.
    """

    folder: Path
    load_scenes: Callable[[], Sequence[TrainingScene]]
    loss: LossConfig
    plan: UnrollSettings
    adam_learning_rates: tuple[float, ...]
    distance: ImageDistance | None
    every: int
    steps: int
    _scenes: Sequence[TrainingScene] = ()

    def score_at_checkpoint(self, done: int, network: LearnedOptimiser) -> None:
        """Adds a row for each scene to ``validation.parquet``, where a validation is due.

        Args:
            done: weight updates done.
            network: the network in training.
        """
        path = self.folder / SCORES_FILE
        # Rows of later updates are of a checkpoint that was not completed: these updates are made again.
        rows = [row for row in load_rows(path, VALIDATION_SCORES) if row["step"] < done]
        last = max((row["step"] for row in rows), default=0)
        # Checkpoints need not fall on multiples of `every`: what counts is whether one was passed.
        if done // self.every == last // self.every and done != self.steps:
            return
        self._scenes = self._scenes or self.load_scenes()
        # The start and tuned Adam do not change with the network: they are scored once.
        known = {row["scene"]: (row["start_db"], row["adam_db"]) for row in rows}
        for scene in self._scenes:
            if scene.name not in known:
                # At the network's own learning rates, so that the difference is what the network adds.
                adam = TunedAdam(LearningRates.from_sequence(self.adam_learning_rates))
                known[scene.name] = (mean_psnr(scene.scene, scene.heldout), self._score(adam, scene))
            start_db, adam_db = known[scene.name]
            began = time.perf_counter()
            learned_db = self._score(network, scene)
            row = {"step": done, "scene": scene.name, "start_db": start_db, "adam_db": adam_db}
            rows.append(row | {"learned_db": learned_db, "seconds": time.perf_counter() - began})
        save_rows(path, VALIDATION_SCORES, rows)

    def _score(self, rule: StepRule, scene: TrainingScene) -> float:
        return score_rule(rule, scene, self.loss, self.plan, self.distance).heldout
