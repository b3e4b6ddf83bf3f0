"""FNet's training pairs: which scenes, how they are degraded, and where they are rendered (paper Sec. IV-A).

Pairs of a scene are one artifact of the training store. Only training seeds, and chunk 0 of a real log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from flows.pipeline.definition import digest_weights
from flows.training.scene_lists import list_scene_recipes
from flows.training.shipped_stages import DENSE
from flows.training.training_scenes import (
    PreparedScene,
    SceneRecipe,
    check_for_training,
    evenly_spaced,
    get_or_make,
    prepare_scene,
)
from genre_tasks.config import GnetConfig, LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import find_nearest_reference, place_novel_views
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.weights import resolve_weights
from storage.address import Address
from storage.keys import digest_value
from storage.store import Store

if TYPE_CHECKING:
    from genre_tasks.fixer.pairs import Pairs
    from genre_tasks.scene.graph import SceneGraph

# The fixer is used at 3 m, so that shift is drawn most; the others keep it from learning one distance by heart.
SHIFTS_M = (1.0, 2.0, 3.0, 3.0, 3.0, 4.0, 5.0)
"""Lateral shifts of training pairs in metres, drawn with a random sign."""

SIDE_M = 3.0
"""Validation pairs are at this shift alone, to either side."""

LIDAR_POINTS = 200_000
"""Points of the LiDAR map at most."""


@dataclass(frozen=True)
class PairSet:
    """Pairs of one kind.

    Attributes:
        kind: what the pairs are called.
        count: how many of a street.
        location: ``beside`` the path at :data:`SHIFTS_M`, or at ``side`` (:data:`SIDE_M` alone), where a street's
            truth is ray-cast; or at recorded images that the reconstruction is not fitted to: held-out frames, source
            frames left out (``unseen``), or a camera left out (``camera``).
        real: how many of a real log.
        keep_every: of the source frames every n-th is kept.
        early_snapshot: the scene is what GNet has after a sixth or a third of its iterations.
        free_ground: the ground is not constrained, as in scenes by other methods.
        perturbation: the scene is perturbed, by a strength drawn between these.
    """

    kind: str
    count: int
    location: Literal["beside", "side", "unseen", "camera"]
    real: int = 0
    keep_every: int = 1
    early_snapshot: bool = False
    free_ground: bool = False
    perturbation: tuple[float, float] | None = None


# Names of the fields in keys. Other names would change the keys of pairs that take hours to make.
_KEY_NAMES = {"location": "at", "early_snapshot": "young", "free_ground": "loose", "perturbation": "perturbed"}


@dataclass(frozen=True)
class PairRecipe:
    """The pairs of a scene, and how it is reconstructed.

    Attributes:
        sets: the pairs of each kind.
        iterations: iterations of GNet.
        views: views per iteration.
    """

    sets: tuple[PairSet, ...] = (
        PairSet("beside", 20, "beside"),
        PairSet("under-trained", 6, "beside", early_snapshot=True),
        PairSet("held-out", 0, "unseen", real=30),
        PairSet("sparse", 6, "unseen", real=30, keep_every=2),
        PairSet("cross-camera", 3, "camera"),
        PairSet("perturbed", 5, "beside", perturbation=(0.3, 1.0)),
        PairSet("loose ground", 10, "beside", free_ground=True),
    )
    iterations: int = 72
    views: int = 3

    def key_fields(self) -> dict[str, Any]:
        """Lists what the pairs depend on, for digests.

        Returns:
            JSON values by field name.
        """
        sets = [{_KEY_NAMES.get(name, name): value for name, value in asdict(s).items()} for s in self.sets]
        return {"sets": sets, "iterations": self.iterations, "views": self.views}


TRAINING_PAIRS = PairRecipe()
VALIDATION_PAIRS = PairRecipe(sets=(PairSet("side", 12, "side"),))


def list_pair_scenes(count: int, real: str | None) -> list[SceneRecipe]:
    """Lists the scenes that pairs are made of: as GNet's last stage has them.

    Args:
        count: how many streets.
        real: URI of a real log, if any.

    Returns:
        The scenes.

    Raises:
        ConfigError: there is none, or a chunk is not for training.
    """
    scenes = list_scene_recipes(replace(DENSE, count=count, real=1), real)
    if not scenes:
        raise ConfigError("there is nothing to make pairs of", remedy="Give --streets or --real.")
    for scene in scenes:
        check_for_training(scene)
    return scenes


def list_validation_scenes(seeds: Sequence[int] = (900, 901, 902)) -> list[SceneRecipe]:
    """Lists streets that no network is trained on, with as many Gaussians as the preset ``small`` has.

    Args:
        seeds: of the streets.

    Returns:
        The scenes.
    """
    return [
        SceneRecipe(f"synthetic:street?seed={seed}", max_points=40_000, distant_count=4_000, every=4, novel_every=1000)
        for seed in seeds
    ]


def get_pairs(store: Store, scene: SceneRecipe, recipe: PairRecipe | None = None) -> Pairs:
    """Reads the pairs of one scene from the store, or makes and stores them.

    Args:
        store: the training's store.
        scene: the scene.
        recipe: which pairs; by default :data:`TRAINING_PAIRS`.

    Returns:
        The pairs on the CPU.
    """
    recipe = recipe or TRAINING_PAIRS
    log = open_log(scene.uri)
    weights = digest_weights(resolve_weights("gnet", "builtin"))
    key = digest_value({"scene": scene.key_fields(), "pairs": recipe.key_fields(), "gnet": weights})
    address = Address(log.dataset, log.name, scene.chunk, "pairs", key)
    found: Pairs = get_or_make(store, address, "pairs", lambda: make_pairs(prepare_scene(store, scene), recipe))
    return found


def make_pairs(prepared: PreparedScene, recipe: PairRecipe) -> Pairs:
    """Makes all pairs of a scene; the same scene and recipe give the same pairs.

    Args:
        prepared: the scene's parts.
        recipe: which pairs.

    Returns:
        The pairs on the CPU.
    """
    from genre_tasks.fixer.pairs import concatenate_pairs, render_pairs
    from genre_tasks.fixer.source_images import load_source_images

    chunk = prepared.chunk
    log = open_log(prepared.recipe.uri)
    # A seed of its own for each log, or all scenes would be shifted by the same distances.
    rng = np.random.default_rng(np.random.SeedSequence([int(digest_value(prepared.recipe.uri)[:8], 16)]))
    sources = load_source_images(chunk)
    lidar = build_lidar_scene(chunk, LIDAR_POINTS)
    # Several kinds share a reconstruction, which takes longer than all renders of its pairs.
    scenes = _DegradedScenes(prepared, recipe)
    parts = []
    for pair_set in recipe.sets:
        count = pair_set.count if log.truth is not None else pair_set.real
        # A real log has no truth beside the path, so most kinds have none of its views.
        if not count:
            continue
        partial, views = _choose_views(chunk, pair_set, count, rng)
        scene = scenes.get(partial, pair_set, rng)
        # The fixer samples the images that the reconstruction was fitted to, and no others. Points took their colours
        # from all source views at ingest, though: of those that a set leaves out, the LiDAR map and the scene's start
        # still hold pixels. The shipped weights were trained so.
        allowed = {(v.camera, v.frame) for v in partial.views_with_role("source")}
        references = [s for s in sources if (s.camera, s.frame) in allowed]
        truth = _load_truth(log, chunk, pair_set, views)
        parts.append(render_pairs(pair_set.kind, partial, scene, lidar, views, truth, references))
    return concatenate_pairs(parts)


class _DegradedScenes:
    """Reconstructions of a chunk, each from the source views that are left of it, made once."""

    def __init__(self, prepared: PreparedScene, recipe: PairRecipe) -> None:
        self._initial = prepared.initial
        self._recipe = recipe
        self._reconstructions: dict[tuple[Any, ...], Reconstruction] = {}

    def get(self, partial: Chunk, pair_set: PairSet, rng: np.random.Generator) -> SceneGraph:
        import torch

        from genre_tasks.fixer.pairs import perturb_scene

        reconstruction = self._reconstruct(partial, pair_set.free_ground)
        if pair_set.early_snapshot:
            # Early scenes only: a late one would hardly differ from the finished scene.
            ages = sorted(k for k in reconstruction.snapshots if 0 < k <= self._recipe.iterations / 2)
            return reconstruction.snapshots[ages[int(rng.integers(len(ages)))]]
        if pair_set.perturbation is None:
            return reconstruction.scene
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        return perturb_scene(reconstruction.scene, generator, float(rng.uniform(*pair_set.perturbation)))

    def _reconstruct(self, partial: Chunk, free_ground: bool) -> Reconstruction:
        from genre_tasks.stages.gnet import gnet

        key = (free_ground, *((v.camera, v.frame) for v in partial.views_with_role("source")))
        if key not in self._reconstructions:
            config = GnetConfig(
                iterations=self._recipe.iterations,
                views_per_iteration=self._recipe.views,
                loss=LossConfig(perceptual=0.0),
                snapshots=6,
                constrain_ground=not free_ground,
            )
            self._reconstructions[key] = gnet(config, partial, self._initial)
        return self._reconstructions[key]


def _choose_views(
    chunk: Chunk, pair_set: PairSet, count: int, rng: np.random.Generator
) -> tuple[Chunk, Sequence[NovelView]]:
    """The chunk with the source views that are left, and where it is rendered."""
    if pair_set.location in ("beside", "side"):
        shifts_m = SHIFTS_M if pair_set.location == "beside" else (SIDE_M,)
        views = []
        # Drawn one at a time and in this order: any other would give other pairs for the same scene.
        for _ in range(count):
            shift_m = rng.choice(shifts_m) * rng.choice((-1, 1))
            poses = place_novel_views(chunk, (float(shift_m),))
            views.append(poses[int(rng.integers(len(poses)))])
        return chunk, views
    if pair_set.location == "camera":
        left_out = chunk.camera_names[int(rng.integers(len(chunk.camera_names)))]
        partial = _filter_sources(chunk, lambda v: v.camera != left_out)
        rendered = [v for v in chunk.views if v.camera == left_out]
    else:
        # Held-out frames are never sources, so they are rendered whatever is kept.
        frames = sorted({v.frame for v in chunk.views_with_role("source")})[:: pair_set.keep_every]
        partial = _filter_sources(chunk, lambda v: v.frame in frames)
        rendered = [v for v in chunk.views if v.frame not in frames]
    sources = partial.views_with_role("source")
    return partial, [_as_novel_view(v, sources) for v in evenly_spaced(rendered, count)]


def _filter_sources(chunk: Chunk, is_kept: Callable[[View], bool]) -> Chunk:
    return replace(chunk, views=tuple(v for v in chunk.views if v.role != "source" or is_kept(v)))


def _as_novel_view(view: View, sources: Sequence[View]) -> NovelView:
    nearest = find_nearest_reference(view.camera, view.chunk_SE3_camera, sources)
    # It is on the path: its shift is 0, and its truth is the recorded image.
    return NovelView(
        view.camera, view.frame, 0.0, view.chunk_SE3_camera, lens=view.lens, reference=(nearest.camera, nearest.frame)
    )


def _load_truth(
    log: DrivingLog, chunk: Chunk, pair_set: PairSet, views: Sequence[NovelView]
) -> list[NDArray[np.uint8]]:
    """The true images: ray-cast beside the path, else recorded."""
    from genre_tasks.scene.image_decoding import decode_pixels

    if pair_set.location in ("beside", "side"):
        assert log.truth is not None
        return [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    # At the working resolution, which renders have too.
    recorded = {(v.camera, v.frame): v for v in chunk.views}
    return [decode_pixels(recorded[v.camera, v.frame].image, v.lens.width_px, v.lens.height_px) for v in views]
