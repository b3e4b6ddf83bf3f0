"""A training stage as plain functions: its scenes, its network, its checkpoints; what the flows and tests call."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from flows.pipeline.definition import weights_digest
from flows.training import checkpoint
from flows.training.scene_starts import Begin, ByGnet, begin_key, begun, make_ages
from flows.training.device import chosen_device, scene_on
from flows.training.fixed_images import fixed_views, images_key, stand_in_views
from flows.training.optimiser_training import CHECKPOINT, WEIGHTS, network_from, train_optimiser
from flows.training.recipes import SHIPPED, Stage, scene_recipes, table_of
from flows.training.training_scenes import PreparedScene, SceneRecipe, check_training, prepare, training_scene
from flows.training.validation import Validation, validation_recipes
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.registry import open_log
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.losses.rendering_loss import Distance
from genre_tasks.optimiser.residual_splitting import split_where_images_have_more
from genre_tasks.losses.targets import of_fixed
from genre_tasks.optimiser.unroll import Plan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.weights import resolve_weights
from storage.keys import digest_value
from storage.local import LocalStore


@dataclass(frozen=True)
class TrainJob:
    """What a training is told: plain values.

    ``folder`` holds the store of scenes and a folder for each stage. ``real``: the URI of a log whose chunk 0 is
    trained on. ``novel``: λ_novel of GNet, ``None``: the recipe's. ``validate_every``: weight updates between
    validations, at the next checkpoint; 0: none.
    """

    folder: str
    recipe: str = "shipped"
    real: str | None = None
    novel: float | None = None
    fnet: str = "builtin"
    device: str = "auto"
    save_every: int = 50
    validate_every: int = 0

    @property
    def store(self) -> LocalStore:
        """Where chunks, initial scenes, true views, aged scenes and fixed images are kept."""
        return LocalStore(Path(self.folder) / "store")

    def table(self) -> tuple[Stage, ...]:
        """The recipe's stages."""
        return table_of(self.recipe, self.novel)

    def stage(self, name: str) -> Stage:
        """By its name. Raises ``ConfigError``."""
        found = {stage.name: stage for stage in self.table()}
        if name not in found:
            raise ConfigError(f"the recipe {self.recipe} has no stage {name!r}", remedy=f"Known: {', '.join(found)}.")
        return found[name]

    def weights(self, name: str) -> Path:
        """Those that ship, or of a stage that is trained to its end; raises ``InputError`` for any other."""
        if name.startswith(SHIPPED):
            return resolve_weights("gnet", name)
        folder = Path(self.folder) / name
        path = folder / CHECKPOINT
        remedy = f"Run `genre train {name.split('/', maxsplit=1)[0]} --stage {name}` first."
        if not path.is_file():
            raise InputError(f"the stage {name} is not trained yet", remedy=remedy, file=path)
        described = checkpoint.describe(path)
        done, steps = described["done"], described["config"]["steps"]
        if done < steps:
            raise InputError(f"the stage {name} has made {done} of {steps} weight updates", remedy=remedy, file=path)
        return folder / WEIGHTS


@dataclass(frozen=True)
class Place:
    """A training scene: which chunk, and where its optimisation begins."""

    recipe: SceneRecipe
    begin: Begin


@dataclass(frozen=True)
class Trained:
    """A stage's weights; ``cached``: it was trained before."""

    stage: str
    weights: str
    cached: bool


def places(stage: Stage, real: str | None) -> list[Place]:
    """The stage's training scenes, in order. Raises ``ConfigError`` for a chunk that is not for training."""
    recipes = scene_recipes(stage.scenes, real)
    for recipe in recipes:
        check_training(recipe)
    begins = stage.begins
    rounds = range(stage.scenes.rounds)
    return [Place(r, begins[(k + turn) % len(begins)]) for turn in rounds for k, r in enumerate(recipes)]


def works(table: Sequence[Stage], real: str | None) -> dict[SceneRecipe, list[tuple[Stage, Begin]]]:
    """For each chunk that a table's stages train on, in their order: the stages, and where it begins in them."""
    out: dict[SceneRecipe, list[tuple[Stage, Begin]]] = {}
    for stage in table:
        for place in places(stage, real):
            if (stage, place.begin) not in out.setdefault(place.recipe, []):
                out[place.recipe].append((stage, place.begin))
    return out


def make_scene(job: TrainJob, recipe: SceneRecipe, uses: Sequence[tuple[Stage, Begin]]) -> int:
    """Makes what the store lacks of a training scene, all but what needs weights yet to be trained.

    Chunk, initial scene, true views, per-scene 3DGS at its ages, FNet's images. Returns how many artifacts were made.
    """
    store, log = job.store, open_log(recipe.uri)

    def count() -> int:
        return sum(1 for _ in store.artifacts(log.dataset, log.name, recipe.chunk))

    before = count()
    scene = prepare(store, recipe)
    pairs = [(stage, (begin, _rendered(stage, begin))) for stage, begin in uses]
    ready = [(stage, both) for stage, both in pairs if not any(isinstance(b, ByGnet) for b in both)]
    make_ages(store, scene, [b for _, both in ready for b in both], job.weights)
    for stage, (begin, _) in ready:
        if stage.images is not None and stage.images.by == "fnet":
            _images(job, stage, scene, begin)
    return count() - before


def load_scenes(job: TrainJob, stage: Stage, at: Sequence[Place], progress: Progress = silent) -> list[TrainingScene]:
    """The training scenes from the store; what it lacks is made. A chunk's images are decoded once."""
    chunks: dict[SceneRecipe, tuple[PreparedScene, TrainingScene]] = {}
    out = []
    for k, place in enumerate(at):
        progress(k, len(at), place.recipe.uri)
        if place.recipe not in chunks:
            prepared = prepare(job.store, place.recipe)
            chunks[place.recipe] = prepared, training_scene(prepared)
        prepared, bare = chunks[place.recipe]
        start = begun(job.store, prepared, place.begin, job.weights)
        fixed = _images(job, stage, prepared, place.begin)
        seen = () if fixed is None else of_fixed(fixed)
        scene = split_where_images_have_more(start.scene, [*bare.source, *seen], stage.split)
        out.append(replace(bare, name=f"{bare.name} {place.begin}", scene=scene, fixed=seen, truth=bare.truth or seen))
    return out


def train_stage(job: TrainJob, stage: Stage, progress: Progress = silent) -> Trained:
    """Trains a stage to its end in its folder, or finds it trained; resumes to the same bytes.

    Raises ``InputError`` where a stage that it needs is not trained, or its folder holds another training.
    """
    folder = Path(job.folder) / stage.name
    weights, at = folder / WEIGHTS, places(stage, job.real)
    origin = _origin(job, stage, at)
    if (folder / CHECKPOINT).is_file() and _finished(folder / CHECKPOINT, stage, origin):
        return Trained(stage.name, str(weights), cached=True)
    start = None if stage.start is None else job.weights(stage.start)
    device = chosen_device(job.device)
    network = network_from(stage.network, 0, start, stage.new_head).to(device)
    scenes = [scene_on(scene, device) for scene in load_scenes(job, stage, at, progress)]
    distance, watch = _distance(stage, device), None
    if job.validate_every:
        watch = _validation(job, stage, folder, distance).at_checkpoint
    train_optimiser(network, scenes, stage.config, folder, distance, job.save_every, watch, progress, origin)
    return Trained(stage.name, str(weights), cached=False)


def _origin(job: TrainJob, stage: Stage, at: Sequence[Place]) -> dict[str, str]:
    """Digests of what the training depends on beside its configuration: the weights it starts from, its scenes."""
    scenes = []
    for place in at:
        scenes.append(begin_key(place.recipe, place.begin, job.weights))
        if stage.images is not None and stage.images.by == "fnet":
            scenes.append(images_key(place.recipe, _rendered(stage, place.begin), job.weights, job.fnet))
    by = None if stage.images is None else stage.images.by
    start = None if stage.start is None else weights_digest(job.weights(stage.start))
    return {"start": start or "none", "training scenes": digest_value([by, *scenes])}


def _finished(path: Path, stage: Stage, origin: dict[str, str]) -> bool:
    """Whether the checkpoint is the end of just this training; one that does not fit is left to be refused."""
    described = checkpoint.describe(path)
    config, network = stage.config.model_dump(mode="json"), stage.network.model_dump(mode="json")
    fits = (described["config"], described["network"], described["origin"]) == (config, network, origin)
    return fits and described["done"] >= stage.config.steps


def _images(job: TrainJob, stage: Stage, scene: PreparedScene, begin: Begin) -> FixedViews | None:
    """The images beside the path that the stage's optimiser sees, if it sees any."""
    if stage.images is None:
        return None
    rendered = _rendered(stage, begin)
    start = begun(job.store, scene, rendered, job.weights)
    if stage.images.by == "stand_in":
        return stand_in_views(scene, start)
    return fixed_views(job.store, scene, rendered, start, job.weights, job.fnet)


def _rendered(stage: Stage, begin: Begin) -> Begin:
    """Which scene's renders the fixer is given."""
    return begin if stage.images is None or stage.images.of is None else stage.images.of


def _distance(stage: Stage, device: torch.device) -> Distance | None:
    """The perceptual distance, where a loss of the stage has a term for it."""
    if stage.config.loss.perceptual == 0 and stage.config.judge_loss.perceptual == 0:
        return None
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance().to(device)


def _validation(job: TrainJob, stage: Stage, folder: Path, distance: Distance | None) -> Validation:
    config, device = stage.config, chosen_device(job.device)

    def scenes() -> list[TrainingScene]:
        at = [Place(recipe, stage.begins[0]) for recipe in validation_recipes(stage.scenes)]
        return [scene_on(scene, device) for scene in load_scenes(job, stage, at)]

    plan = Plan(statistics.mode(config.iterations), statistics.mode(config.views), config.novel_views, stage=stage.of)
    return Validation(
        folder, scenes, config.loss, plan, stage.network.rates, distance, job.validate_every, config.steps
    )
