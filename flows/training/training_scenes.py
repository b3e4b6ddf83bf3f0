"""Training scenes of the optimiser: chunks, initial scenes and true novel views, kept in a store of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import torch

from flows.pipeline.log_cache import cached_log
from flows.training.subsampled_log import SubsampledLog
from genre_tasks.config import EffectsConfig, IngestConfig, InitialConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from genre_tasks.losses.targets import novel_targets, source_targets, view_targets
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.effects import effects
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from storage.address import Address
from storage.keys import digest_value
from storage.store import Artifact, Store

TRAINING_SEEDS = range(0, 900)
"""Seeds of the synthetic street (configs/seeds.yaml): no other may be used to train."""

# What changes how Gaussians become an image, and not what they hold. Blurred images are left out because they take a
# quarter of an hour to draw.
TRAINING_EFFECTS = EffectsConfig(view_dependent_colour="off", nonrigid_actors="off", motion_blur="off")
"""The effects that a planned training scene may have."""


@dataclass(frozen=True)
class SceneRecipe:
    """How a training scene is made.

    Attributes:
        uri: the log.
        chunk: index of the chunk in the log.
        max_points: so many LiDAR points become Gaussians at most.
        distant_count: Gaussians of the distant shell.
        width_px: width of images.
        height_px: height of images.
        every: only every n-th frame's images are kept, since a ray-cast image costs half a second. A divisor of four
            keeps the source views.
        novel_every: every n-th of the novel views is ray-cast as truth.
        shifts_m: lateral shifts of the novel views in metres, left is positive.
        planned: rolling shutter, lens distortion and the like are modelled where the log calls for them
            (:data:`TRAINING_EFFECTS`).
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

    def key_fields(self) -> dict[str, Any]:
        """Lists what makes it this scene, for digests.

        Returns:
            JSON values by field name.
        """
        return self.seed_fields() | self._log_fields()

    def seed_fields(self) -> dict[str, Any]:
        """Lists what random numbers of this scene follow from: how it is made, and not what its log's files hold.

        Returns:
            JSON values by field name.
        """
        values = asdict(self)
        # Plain scenes keep the digests that they had before there were plans.
        if not self.planned:
            del values["planned"]
        return values

    def _log_fields(self) -> dict[str, str]:
        """The files of a real log: they may be corrected, or be others in another working folder."""
        # A street follows from its URI.
        return {} if self.uri.startswith("synthetic:") else {"log": cached_log(self.uri).digest()}

    def image_key_fields(self) -> dict[str, Any]:
        """Lists what the scene's images depend on, for digests.

        The number of Gaussians is not part of it, so scenes of several sizes share their images.

        Returns:
            JSON values by field name.
        """
        values = self.seed_fields()
        fields = {name: values[name] for name in ("uri", "chunk", "width_px", "height_px", "every")}
        return fields | self._log_fields()

    def truth_key_fields(self) -> dict[str, Any]:
        """Lists what the scene's true novel views depend on, for digests.

        Returns:
            JSON values by field name.
        """
        # Neither points nor Gaussians are in this key: ray casting is the costliest part and depends on neither.
        return self.image_key_fields() | {"novel_every": self.novel_every, "shifts_m": self.shifts_m}


@dataclass(frozen=True)
class PreparedScene:
    """The parts of a training scene as the stages leave them.

    Attributes:
        recipe: how it was made.
        chunk: the chunk, with its plan of effects applied where it has one.
        initial: the initial scene.
        truth: true images at novel views; ``None`` for a real log.
    """

    recipe: SceneRecipe
    chunk: Chunk
    initial: Reconstruction
    truth: FixedViews | None


def check_for_training(recipe: SceneRecipe) -> None:
    """Refuses streets and chunks that results are claimed on, as far as a URI tells.

    Args:
        recipe: the scene to train on.

    Raises:
        ConfigError: a synthetic seed is outside 0 to 899, or the chunk of any log is not chunk 0.

    >>> check_for_training(SceneRecipe("synthetic:street?seed=899"))
    >>> check_for_training(SceneRecipe("pandaset:002?seed=of-somebody"))
    >>> check_for_training(SceneRecipe("synthetic:street?seed=900"))
    Traceback (most recent call last):
    ...
    genre_tasks.errors.ConfigError: ...
    """
    reader, _, query = recipe.uri.partition("?")
    # A street without a seed has seed 0, which is for training.
    seed = parse_qs(query).get("seed", ["0"])[0]
    if reader.startswith("synthetic:") and not (seed.isdecimal() and int(seed) in TRAINING_SEEDS):
        raise ConfigError(
            f"seed {seed} of {recipe.uri} is not for training",
            remedy=f"Use seeds {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}.",
        )
    # Results on PandaSet 002 are claimed on its other chunks. No chunk of KITTI's recording may be trained on, see
    # docs/guides/training.md: a path does not tell which recording it leads to, so this is left to the user.
    if recipe.chunk != 0:
        raise ConfigError(f"chunk {recipe.chunk} of {recipe.uri} is not for training", remedy="Use chunk 0.")


def prepare_scene(store: Store, recipe: SceneRecipe) -> PreparedScene:
    """Reads the parts of a training scene from the store; what it lacks is made and stored.

    Keys are of the recipe and of a real log's files, not of the code: after a change of how scenes are made, take an
    empty store.

    Args:
        store: the training's store.
        recipe: the scene.

    Returns:
        The scene's parts.
    """
    log = open_log(recipe.uri)

    # The code is not part of the keys, so that a change of code which leaves scenes alike keeps hours of work.
    def get_part(stage: str, kind: str, key_fields: dict[str, Any], make: Callable[[], Any]) -> Any:
        address = Address(log.dataset, log.name, recipe.chunk, stage, digest_value(key_fields))
        return get_or_make(store, address, kind, make)

    ingest_config = IngestConfig(width_px=recipe.width_px, height_px=recipe.height_px)
    subsampled: Any = SubsampledLog(log, recipe.every)
    chunk = get_part(
        "ingest", "chunk", recipe.image_key_fields(), lambda: ingest(ingest_config, subsampled, recipe.chunk)
    )
    plan = DEFAULT_PLAN
    if recipe.planned:
        plan = get_part("effects", "effects", recipe.key_fields(), lambda: effects(TRAINING_EFFECTS, chunk, subsampled))
    initial_config = InitialConfig(max_points=recipe.max_points, distant_count=recipe.distant_count)
    start = get_part("initial", "reconstruction", recipe.key_fields(), lambda: initial(initial_config, chunk, plan))
    truth = None
    # Only synthetic logs can be ray-cast away from the recorded path.
    if log.truth is not None:
        truth = get_part(
            "truth", "fixed_views", recipe.truth_key_fields(), lambda: ray_cast_true_views(log, chunk, recipe)
        )
    return PreparedScene(recipe, apply_plan(chunk, plan), start, truth)


def get_or_make(store: Store, address: Address, kind: str, make: Callable[[], Any]) -> Any:
    """Reads a value from the store; made and stored where the store has nothing, or nothing sound.

    Args:
        store: the store.
        address: where the value belongs.
        kind: kind of artifact.
        make: makes the value.

    Returns:
        The value as it is read back, so that a value has passed through its codec on every path.
    """
    try:
        if (artifact := store.find(address)) is not None:
            return store.read(artifact)
    except ArtifactCorruptError:
        if (artifact := _find_or_discard(store, address)) is not None:
            return store.read(artifact)
    return store.read(store.commit(address, kind, make()))


def _find_or_discard(store: Store, address: Address) -> Artifact | None:
    """Looks a damaged artifact up again under its lease: another process may have repaired it; if not, it goes."""
    with store.lease(address):
        artifact = None
        try:
            artifact = store.find(address)
            if artifact is not None:
                # Not only verified: its codec may refuse what another version wrote.
                store.read(artifact)
            return artifact
        except ArtifactCorruptError:
            # Only damage: an artifact of a newer version raises here, since it is not ours to remove.
            store.discard(artifact or address)
            return None


def ray_cast_true_views(log: DrivingLog, chunk: Chunk, recipe: SceneRecipe) -> FixedViews:
    """Ray-casts the true images at every ``novel_every``-th novel view of a synthetic log.

    Args:
        log: a log that knows its truth.
        chunk: the chunk.
        recipe: which views.

    Returns:
        The images [V, H, W, 3] in [0, 1].
    """
    assert log.truth is not None
    views = place_novel_views(chunk, recipe.shifts_m)[:: recipe.novel_every]
    images = [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    # The very floats that decoding an image gives, so that a stored truth equals a fresh one.
    return FixedViews(views, torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255)))


def build_training_scene(
    prepared: PreparedScene,
    start: Reconstruction | None = None,
    fixed: FixedViews | None = None,
    depth: bool = True,
    held_out_count: int = 12,
) -> TrainingScene:
    """Decodes the images of a scene into what meta-training needs.

    Args:
        prepared: the scene's parts.
        start: where the optimisation begins; by default at the initial scene.
        fixed: images at novel views that the optimiser is shown. They also stand in for the truth where there is none.
        depth: source targets have LiDAR depth.
        held_out_count: so many held-out views at most, evenly spaced.

    Returns:
        The scene with its targets.
    """
    chunk = prepared.chunk
    # A real log has no true novel views.
    truth = prepared.truth or fixed
    held_out = evenly_spaced(chunk.views_with_role("heldout"), held_out_count)
    return TrainingScene(
        name=f"{chunk.log}/{chunk.index}",
        scene=(start or prepared.initial).scene,
        source=source_targets(chunk, depth),
        heldout=view_targets(chunk, held_out),
        fixed=() if fixed is None else novel_targets(fixed),
        truth=() if truth is None else novel_targets(truth),
    )


def evenly_spaced(items: Sequence[Any], count: int) -> tuple[Any, ...]:
    """Selects items that are evenly spread over a sequence.

    Args:
        items: the sequence.
        count: how many to select at most.

    Returns:
        The items in order: the first and the last are among them, or the middle one where ``count`` is 1.

    >>> evenly_spaced("abcdefg", 3)
    ('a', 'd', 'g')
    """
    if len(items) <= count:
        return tuple(items)
    if count == 1:
        return (items[len(items) // 2],)
    return tuple(items[round(i * (len(items) - 1) / (count - 1))] for i in range(count))
