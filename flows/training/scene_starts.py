"""Where the optimisation of a training scene begins: initial scenes, per-scene 3DGS at an age, scenes of a GNet.

Each is an artifact of the training store, made once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from flows.pipeline.definition import digest_weights
from flows.training.training_scenes import PreparedScene, SceneRecipe, get_or_make
from genre_tasks.config import LossConfig, OptimiserConfig, PerSceneConfig
from genre_tasks.errors import ConfigError
from genre_tasks.losses.targets import source_targets
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.per_scene.run import train_with_snapshots
from genre_tasks.per_scene.setup import freeze_actors
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.gnet import gnet
from storage.address import Address
from storage.keys import digest_value
from storage.store import Store

LOSS = LossConfig(perceptual=0.0)
"""The loss that tuned Adam and GNet descend when they make starts."""


# Names of these classes and of their fields are part of keys, and seeds are drawn from keys: another name would give
# other scenes. `_key_fields` keeps the one old name that is left.
@dataclass(frozen=True)
class Initial:
    """Begins at the initial scene."""

    def __str__(self) -> str:
        return "initial"


@dataclass(frozen=True)
class Adam:
    """Begins where tuned Adam ends.

    Attributes:
        age: iterations of its schedule, all of which are done.
        views: views per iteration.
    """

    age: int
    views: int = 6

    def __str__(self) -> str:
        return f"adam@{self.age}"


@dataclass(frozen=True)
class PerScene:
    """Begins at a scene that per-scene 3DGS by the published recipe is still optimising.

    Attributes:
        age: iterations done.
        iterations: length of the run.
        method: static, or with moving actors.

    Raises:
        ConfigError: the age is not within the run.

    >>> print(PerScene(120, 960))
    standard_3dgs@120/960
    """

    age: int
    iterations: int
    method: Literal["standard_3dgs", "street_gs"] = "standard_3dgs"

    def __post_init__(self) -> None:
        if not 0 < self.age <= self.iterations:
            raise ConfigError(f"{self} is no age of its run", remedy="Give an age from 1 to the run's length.")

    def __str__(self) -> str:
        return f"{self.method}@{self.age}/{self.iterations}"


@dataclass(frozen=True)
class ByGnet:
    """Begins where a GNet ends.

    Attributes:
        stage: the training stage whose weights it has.
        iterations: iterations of GNet.
        views: views per iteration.
    """

    stage: str
    iterations: int = 24
    views: int = 6

    def __str__(self) -> str:
        return f"gnet@{self.iterations} by {self.stage}"


SceneStart = Initial | Adam | PerScene | ByGnet

StageWeights = Callable[[str], Path]
"""Finds the weights of a training stage by its name; raises where it is not trained."""


def scene_start_key(recipe: SceneRecipe, start: SceneStart, stage_weights: StageWeights) -> str:
    """Computes the key of a scene at its start.

    Args:
        recipe: the scene.
        start: where its optimisation begins.
        stage_weights: finds the weights that take part, whose bytes count and not their name.

    Returns:
        64 hex digits.
    """
    fields = _key_fields(start)
    if isinstance(start, ByGnet):
        # By its bytes, so that a stage that was trained again gives new starts.
        fields["stage"] = digest_weights(stage_weights(start.stage))
    return digest_value({"recipe": recipe.key_fields(), "begin": [type(start).__name__, fields]})


def get_start(store: Store, scene: PreparedScene, start: SceneStart, stage_weights: StageWeights) -> Reconstruction:
    """Reads the scene at its start from the store, or makes and stores it.

    Args:
        store: the training's store.
        scene: the training scene.
        start: where its optimisation begins.
        stage_weights: finds the weights that take part.

    Returns:
        The scene there.

    Raises:
        InputError: the stage whose weights take part is not trained.
    """
    # The initial scene is an artifact of its own already.
    if isinstance(start, Initial):
        return scene.initial
    address = _address(scene, start, stage_weights)
    value: Reconstruction = get_or_make(
        store, address, "reconstruction", lambda: _make_start(scene, start, stage_weights)
    )
    return value


def make_starts(store: Store, scene: PreparedScene, starts: Sequence[SceneStart], stage_weights: StageWeights) -> int:
    """Makes what the store lacks of several starts of one scene.

    Args:
        store: the training's store.
        scene: the training scene.
        starts: where its optimisation begins.
        stage_weights: finds the weights that take part.

    Returns:
        How many were made.
    """
    wanted = [start for start in dict.fromkeys(starts) if not isinstance(start, Initial)]
    # Asked before anything is made: one missing age makes its whole run necessary.
    missing = [start for start in wanted if store.find(_address(scene, start, stage_weights)) is None]
    # Ages of one run are made together: the run to the oldest passes all the others.
    runs: dict[Any, list[PerScene]] = {}
    for start in missing:
        if isinstance(start, PerScene):
            runs.setdefault((start.method, start.iterations), []).append(start)
        else:
            get_start(store, scene, start, stage_weights)
    for ages in runs.values():
        for age, value in _run_per_scene(scene, ages).items():
            store.commit(_address(scene, age, stage_weights), "reconstruction", value)
    return len(missing)


def _key_fields(start: SceneStart) -> dict[str, Any]:
    fields = asdict(start)
    if isinstance(start, PerScene):
        # The key's old name; scenes that took hours to make would not be found under a new one.
        fields["of"] = fields.pop("iterations")
    return fields


def _address(scene: PreparedScene, start: SceneStart, stage_weights: StageWeights) -> Address:
    method = {Adam: "adam", ByGnet: "gnet"}.get(type(start)) or getattr(start, "method", "")
    chunk = scene.chunk
    key = scene_start_key(scene.recipe, start, stage_weights)
    return Address(chunk.dataset, chunk.log, chunk.index, f"per_scene/{method}", key)


def _make_start(scene: PreparedScene, start: SceneStart, stage_weights: StageWeights) -> Reconstruction:
    seed = _seed_from(scene_start_key(scene.recipe, start, stage_weights))
    if isinstance(start, Adam):
        return _run_adam(scene, start, seed)
    if isinstance(start, PerScene):
        return _run_per_scene(scene, [start])[start]
    assert isinstance(start, ByGnet)
    return _run_gnet(scene, start, stage_weights(start.stage), seed)


def _seed_from(key: str) -> int:
    # A seed of its own for each scene and start, or all of them would draw their views in one order.
    return int(key[:7], 16)


def _run_adam(scene: PreparedScene, start: Adam, seed: int) -> Reconstruction:
    source = source_targets(scene.chunk, depth=True)
    plan = UnrollSettings(start.age, start.views, seed=seed, stage="per_scene")
    return unroll(TunedAdam(), scene.initial.scene, source, (), Objective(LOSS), plan)


def _run_gnet(scene: PreparedScene, start: ByGnet, weights: Path, seed: int) -> Reconstruction:
    settings = {
        "iterations": start.iterations,
        "views_per_iteration": start.views,
        "loss": LOSS,
        "weights": str(weights),
        "snapshots": 0,
        "seed": seed,
    }
    return gnet(OptimiserConfig.model_validate(settings), scene.chunk, scene.initial)


def _run_per_scene(scene: PreparedScene, starts: Sequence[PerScene]) -> dict[PerScene, Reconstruction]:
    """One run of one method and length, from which the scene at each age is taken."""
    method = starts[0].method
    iterations = starts[0].iterations
    by_age = {start.age: start for start in starts}
    # The published 3DGS knows no motion, so its errors at actors are part of what ENet has to repair.
    initial = scene.initial.scene if method == "street_gs" else freeze_actors(scene.initial.scene)
    # The seed is the run's and not the age's, so that all ages lie on one optimisation.
    seed = _seed_from(digest_value([scene.recipe.seed_fields(), method, iterations]))
    training = PerSceneTraining(
        PerSceneConfig(iterations=iterations), initial, source_targets(scene.chunk, depth=False), seed, "per_scene"
    )
    found: dict[PerScene, Reconstruction] = {}
    for snapshot in train_with_snapshots(training, iterations=tuple(by_age)):
        if (start := by_age.get(snapshot.iteration)) is not None:
            found[start] = Reconstruction(snapshot.scene)
        # The rest of the schedule is not needed: an age is a scene in the middle of its run.
        if snapshot.iteration >= max(by_age):
            break
    return found
