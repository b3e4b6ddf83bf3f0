"""Training scenes of the optimiser: chunks, initial scenes and true novel views, kept in a store of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import torch

from flows.training.subsampled_log import ThinnedLog
from genre_tasks.config import EffectsConfig, IngestConfig, InitialConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.losses.targets import of_fixed, of_source, of_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.stages.effects import effects
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from storage.address import Address
from storage.keys import digest_value
from storage.local import LocalStore

TRAINING_SEEDS = range(0, 900)
"""Seeds of the synthetic street (configs/seeds.yaml): no other may be used to train."""

PLANNED = EffectsConfig(view_dependent_colour="off", nonrigid_actors="off", motion_blur="off")
"""What a planned training scene may have: what changes how Gaussians become an image, and not what they hold. Blurred
images take a quarter of an hour to draw."""


@dataclass(frozen=True)
class SceneRecipe:
    """How a training scene is made.

    ``every``: only every n-th frame's images are kept (a ray-cast image costs half a second); a divisor of four keeps
    the source views. ``novel_every``: every n-th of the views at ±3 m is ray-cast as truth. ``planned``: rolling
    shutter, lens distortion and the like are modelled where the log calls for them (:data:`PLANNED`).
    """

    uri: str
    chunk: int = 0
    max_points: int = 18_000
    distant_count: int = 2_000
    width_px: int = 320
    height_px: int = 180
    every: int = 2
    novel_every: int = 2
    shifts_m: tuple[float, ...] = (3.0, -3.0)
    planned: bool = False

    def said(self) -> dict[str, Any]:
        """What makes it this scene, for digests: plain scenes keep those that they had before plans."""
        own = asdict(self)
        if not self.planned:
            del own["planned"]
        return own

    def images(self) -> dict[str, Any]:
        """What its images depend on, and not how many Gaussians begin: scenes of several sizes share them."""
        own = self.said()
        return {name: own[name] for name in ("uri", "chunk", "width_px", "height_px", "every")}

    def truths(self) -> dict[str, Any]:
        """What its true views beside the path depend on."""
        return self.images() | {"novel_every": self.novel_every, "shifts_m": self.shifts_m}


@dataclass(frozen=True)
class PreparedScene:
    """The parts of a training scene as the stages leave them, the chunk with its plan applied where it has one.

    ``truth`` is ``None`` for a real log.
    """

    recipe: SceneRecipe
    chunk: Chunk
    start: Reconstruction
    truth: FixedViews | None


def check_training(recipe: SceneRecipe) -> None:
    """Raises ``ConfigError`` for a synthetic seed outside 0–899 and for any chunk but 0: those are for claims."""
    reader, _, query = recipe.uri.partition("?")
    seed = int(parse_qs(query).get("seed", ["0"])[0])
    if reader.startswith("synthetic:") and seed not in TRAINING_SEEDS:
        raise ConfigError(
            f"seed {seed} of {recipe.uri} is not for training",
            remedy=f"Use seeds {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}.",
        )
    if recipe.chunk != 0:
        raise ConfigError(f"chunk {recipe.chunk} of {recipe.uri} is not for training", remedy="Use chunk 0.")


def prepare(store: LocalStore, recipe: SceneRecipe) -> PreparedScene:
    """Reads the scene from the store, or makes and stores it.

    Keys are the recipe's alone, not the code's: after a change of how scenes are made, take an empty store.
    """
    log = open_log(recipe.uri)

    def part(stage: str, kind: str, said: dict[str, Any], make: Callable[[], Any]) -> Any:
        return kept(store, Address(log.dataset, log.name, recipe.chunk, stage, digest_value(said)), kind, make)

    sizes = {"width_px": recipe.width_px, "height_px": recipe.height_px}
    thinned: Any = ThinnedLog(log, recipe.every)
    chunk = part("ingest", "chunk", recipe.images(), lambda: ingest(IngestConfig(**sizes), thinned, recipe.chunk))
    points = InitialConfig(max_points=recipe.max_points, distant_count=recipe.distant_count)
    plan = UNPLANNED
    if recipe.planned:
        plan = part("effects", "effects", recipe.said(), lambda: effects(PLANNED, chunk, thinned))
    start = part("initial", "reconstruction", recipe.said(), lambda: initial(points, chunk, plan))
    truth = None
    if log.truth is not None:
        truth = part("truth", "fixed_views", recipe.truths(), lambda: true_views(log, chunk, recipe))
    return PreparedScene(recipe, applied(chunk, plan), start, truth)


def kept(store: LocalStore, address: Address, kind: str, make: Callable[[], Any]) -> Any:
    """What the store has at ``address``, read back; made and stored where it has nothing, or nothing sound."""
    try:
        if (artifact := store.find(address)) is not None:
            return store.read(artifact)
    except ArtifactCorruptError:
        store.discard(address)
    return store.read(store.commit(address, kind, make()))


def true_views(log: DrivingLog, chunk: Chunk, recipe: SceneRecipe) -> FixedViews:
    """The ray-cast images at every ``novel_every``-th view beside the path."""
    assert log.truth is not None
    views = novel_view_poses(chunk, recipe.shifts_m)[:: recipe.novel_every]
    images = [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    return FixedViews(views, torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255)))


def training_scene(
    prepared: PreparedScene,
    start: Reconstruction | None = None,
    fixed: FixedViews | None = None,
    depth: bool = True,
    heldout: int = 12,
) -> TrainingScene:
    """Targets decoded; ``start`` replaces the initial scene, ``fixed`` is what the optimiser sees beside the path.

    True images judge at the novel views where they exist, else the fixed ones.
    """
    chunk = prepared.chunk
    judge = prepared.truth or fixed
    views = spread(chunk.of_role("heldout"), heldout)
    return TrainingScene(
        f"{chunk.log}/{chunk.index}",
        (start or prepared.start).scene,
        of_source(chunk, depth),
        of_views(chunk, views),
        () if fixed is None else of_fixed(fixed),
        () if judge is None else of_fixed(judge),
    )


def spread(items: Sequence[Any], count: int) -> tuple[Any, ...]:
    """At most ``count`` of the items, evenly spread; the middle one where it is one."""
    if len(items) <= count:
        return tuple(items)
    if count == 1:
        return (items[len(items) // 2],)
    return tuple(items[round(i * (len(items) - 1) / (count - 1))] for i in range(count))
