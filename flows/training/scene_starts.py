"""Where the optimisation of a training scene begins: initial scenes, per-scene 3DGS at an age, scenes of a GNet.

Each is an artifact of the training store, made once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from flows.pipeline.definition import weights_digest
from flows.training.training_scenes import PreparedScene, SceneRecipe, kept
from genre_tasks.config import LossConfig, OptimiserConfig, PerSceneConfig
from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.objective import Objective
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.per_scene.run import snapshots
from genre_tasks.per_scene.setup import world_static
from genre_tasks.losses.targets import of_source
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.gnet import gnet
from storage.address import Address
from storage.keys import digest_value
from storage.local import LocalStore

LOSS = LossConfig(perceptual=0.0)
"""What tuned Adam and GNet descend."""


@dataclass(frozen=True)
class Initial:
    """At the initial scene."""

    def __str__(self) -> str:
        return "initial"


@dataclass(frozen=True)
class Adam:
    """At what tuned Adam leaves after all ``age`` iterations of its schedule."""

    age: int
    views: int = 6

    def __str__(self) -> str:
        return f"adam@{self.age}"


@dataclass(frozen=True)
class PerScene:
    """At what per-scene 3DGS by the published recipe holds after ``age`` of its ``of`` iterations."""

    age: int
    of: int
    method: Literal["standard_3dgs", "street_gs"] = "standard_3dgs"

    def __post_init__(self) -> None:
        if not 0 < self.age <= self.of:
            raise ConfigError(f"{self} is no age of its run", remedy="Give an age from 1 to the run's length.")

    def __str__(self) -> str:
        return f"{self.method}@{self.age}/{self.of}"


@dataclass(frozen=True)
class ByGnet:
    """At what a GNet leaves whose weights are those of the training stage ``stage``."""

    stage: str
    iterations: int = 24
    views: int = 6

    def __str__(self) -> str:
        return f"gnet@{self.iterations} by {self.stage}"


Begin = Initial | Adam | PerScene | ByGnet

Weights = Callable[[str], Path]
"""The weights of a training stage by its name; raises where it is not trained."""


def begin_key(recipe: SceneRecipe, begin: Begin, weights: Weights) -> str:
    """The artifact's key: the scene's recipe, how it begins, and the bytes of the weights that took part."""
    by = weights_digest(weights(begin.stage)) if isinstance(begin, ByGnet) else None
    what = [type(begin).__name__, asdict(begin) if by is None else {**asdict(begin), "stage": by}]
    return digest_value({"recipe": recipe.said(), "begin": what})


def begun(store: LocalStore, scene: PreparedScene, begin: Begin, weights: Weights) -> Reconstruction:
    """The scene where ``begin`` says, from the store, or made and stored."""
    if isinstance(begin, Initial):
        return scene.start
    address = _address(scene, begin, weights)
    value: Reconstruction = kept(store, address, "reconstruction", lambda: _made(scene, begin, weights))
    return value


def make_ages(store: LocalStore, scene: PreparedScene, begins: Sequence[Begin], weights: Weights) -> int:
    """Makes those of ``begins`` that the store lacks, per-scene 3DGS of one length in one run; returns how many."""
    wanted = [b for b in dict.fromkeys(begins) if not isinstance(b, Initial)]
    missing = [b for b in wanted if store.find(_address(scene, b, weights)) is None]
    runs: dict[Any, list[PerScene]] = {}
    for begin in missing:
        if isinstance(begin, PerScene):
            runs.setdefault((begin.method, begin.of), []).append(begin)
        else:
            begun(store, scene, begin, weights)
    for ages in runs.values():
        for age, value in _per_scene(scene, ages).items():
            store.commit(_address(scene, age, weights), "reconstruction", value)
    return len(missing)


def _address(scene: PreparedScene, begin: Begin, weights: Weights) -> Address:
    kind = {Adam: "adam", ByGnet: "gnet"}.get(type(begin)) or getattr(begin, "method", "")
    chunk = scene.chunk
    return Address(chunk.dataset, chunk.log, chunk.index, f"per_scene/{kind}", begin_key(scene.recipe, begin, weights))


def _made(scene: PreparedScene, begin: Begin, weights: Weights) -> Reconstruction:
    seed = int(begin_key(scene.recipe, begin, weights)[:7], 16)
    if isinstance(begin, Adam):
        return _adam(scene, begin, seed)
    if isinstance(begin, PerScene):
        return _per_scene(scene, [begin])[begin]
    assert isinstance(begin, ByGnet)
    return _by_gnet(scene, begin, weights(begin.stage), seed)


def _adam(scene: PreparedScene, begin: Adam, seed: int) -> Reconstruction:
    source = of_source(scene.chunk, depth=True)
    plan = Plan(begin.age, begin.views, seed=seed, stage="per_scene")
    return unroll(TunedAdam(), scene.start.scene, source, (), Objective(LOSS), plan)


def _by_gnet(scene: PreparedScene, begin: ByGnet, weights: Path, seed: int) -> Reconstruction:
    length = {"iterations": begin.iterations, "views_per_iteration": begin.views}
    config = OptimiserConfig.model_validate(
        {**length, "loss": LOSS, "weights": str(weights), "snapshots": 0, "seed": seed}
    )
    return gnet(config, scene.chunk, scene.start)


def _per_scene(scene: PreparedScene, ages: Sequence[PerScene]) -> dict[PerScene, Reconstruction]:
    """One run, looked at at each age and stopped at the last."""
    method, of = ages[0].method, ages[0].of
    by_age = {begin.age: begin for begin in ages}
    start = scene.start.scene if method == "street_gs" else world_static(scene.start.scene)
    seed = int(digest_value([scene.recipe.said(), method, of])[:7], 16)
    training = PerSceneTraining(
        PerSceneConfig(iterations=of), start, of_source(scene.chunk, depth=False), seed, "per_scene"
    )
    out: dict[PerScene, Reconstruction] = {}
    for snapshot in snapshots(training, iterations=tuple(by_age)):
        if (begin := by_age.get(snapshot.iteration)) is not None:
            out[begin] = Reconstruction(snapshot.scene)
        if snapshot.iteration >= max(by_age):
            break
    return out
