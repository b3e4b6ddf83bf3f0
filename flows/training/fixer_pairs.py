"""FNet's training pairs: which scenes, how they are degraded, and where they are rendered (paper Sec. IV-A).

Pairs of a scene are one artifact of the training store. Only training seeds, and chunk 0 of a real log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from flows.pipeline.definition import weights_digest
from flows.training.recipes import DENSE, scene_recipes
from flows.training.training_scenes import PreparedScene, SceneRecipe, check_training, kept, prepare, spread
from genre_tasks.config import GnetConfig, LossConfig
from genre_tasks.errors import ConfigError
from genre_tasks.logs.registry import open_log
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.lidar_map import lidar_scene
from genre_tasks.scene.novel_poses import nearest_reference, novel_view_poses
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.weights import resolve_weights
from storage.address import Address
from storage.keys import digest_value
from storage.local import LocalStore

if TYPE_CHECKING:
    from genre_tasks.fixer.pairs import Pairs
    from genre_tasks.fixer.warping import SourceImage
    from genre_tasks.scene.graph import SceneGraph

SHIFTS_M = (1.0, 2.0, 3.0, 3.0, 3.0, 4.0, 5.0)
"""Lateral shifts of training pairs, drawn with a random sign: fixing is done at 3 m, so it is drawn most."""

SIDE_M = 3.0
"""Validation pairs are at this shift alone, to either side."""

LIDAR_POINTS = 200_000


@dataclass(frozen=True)
class PairSet:
    """Pairs of one kind: ``count`` of a street, ``real`` of a real log.

    Rendered ``beside`` the path (or at ``SIDE_M`` alone, ``side``), where the synthetic street's truth is ray-cast, or
    at recorded images that were kept from the reconstruction: held-out frames and source frames left out (``unseen``),
    or a camera left out (``camera``).

    ``keep_every``: of the source frames every n-th is kept. ``young``: the scene is what GNet has after a sixth or a
    third of its iterations. ``loose``: its ground is not held, as in scenes by other methods. ``perturbed``: strengths
    between which one is drawn.
    """

    kind: str
    count: int
    at: Literal["beside", "side", "unseen", "camera"]
    real: int = 0
    keep_every: int = 1
    young: bool = False
    loose: bool = False
    perturbed: tuple[float, float] | None = None


@dataclass(frozen=True)
class PairRecipe:
    """The pairs of a scene, and GNet's length where they are reconstructed."""

    sets: tuple[PairSet, ...] = (
        PairSet("beside", 20, "beside"),
        PairSet("under-trained", 6, "beside", young=True),
        PairSet("held-out", 0, "unseen", real=30),
        PairSet("sparse", 6, "unseen", real=30, keep_every=2),
        PairSet("cross-camera", 3, "camera"),
        PairSet("perturbed", 5, "beside", perturbed=(0.3, 1.0)),
        PairSet("loose ground", 10, "beside", loose=True),
    )
    iterations: int = 72
    views: int = 3


PAIRS = PairRecipe()


def pair_scenes(count: int, real: str | None) -> list[SceneRecipe]:
    """The scenes that pairs are made of: ``count`` streets as GNet's last stage has them, and the real log's.

    Raises ``ConfigError`` for none, and as :func:`flows.training.training_scenes.check_training`.
    """
    scenes = scene_recipes(replace(DENSE, count=count, real=1), real)
    if not scenes:
        raise ConfigError("there is nothing to make pairs of", remedy="Give --streets or --real.")
    for scene in scenes:
        check_training(scene)
    return scenes


def validation_scenes(seeds: Sequence[int] = (900, 901, 902)) -> list[SceneRecipe]:
    """Streets that no network is trained on, with as many Gaussians as the preset ``small`` has."""
    return [
        SceneRecipe(f"synthetic:street?seed={seed}", max_points=40_000, distant_count=4_000, every=4, novel_every=1000)
        for seed in seeds
    ]


VALIDATION = PairRecipe(sets=(PairSet("side", 12, "side"),))


def pairs_of(store: LocalStore, scene: SceneRecipe, recipe: PairRecipe | None = None) -> Pairs:
    """The pairs of one training scene by ``recipe`` (``PAIRS``) from the store, or made and stored."""
    recipe = recipe or PAIRS
    log = open_log(scene.uri)
    weights = weights_digest(resolve_weights("gnet", "builtin"))
    key = digest_value({"scene": scene.said(), "pairs": asdict(recipe), "gnet": weights})
    address = Address(log.dataset, log.name, scene.chunk, "pairs", key)
    found: Pairs = kept(store, address, "pairs", lambda: make_pairs(prepare(store, scene), recipe))
    return found


def make_pairs(prepared: PreparedScene, recipe: PairRecipe) -> Pairs:
    """All sets of a scene. Deterministic."""
    from genre_tasks.fixer.source_images import recorded
    from genre_tasks.fixer.pairs import joined, render_pairs

    chunk, log = prepared.chunk, open_log(prepared.recipe.uri)
    rng = np.random.default_rng(np.random.SeedSequence([int(digest_value(prepared.recipe.uri)[:8], 16)]))
    sources, lidar = recorded(chunk), lidar_scene(chunk, LIDAR_POINTS)
    scenes = _Scenes(prepared, recipe)
    parts = []
    for wanted in recipe.sets:
        count = wanted.count if log.truth is not None else wanted.real
        if not count:
            continue
        seen, views = _views(chunk, wanted, count, rng)
        scene = scenes.of(seen, wanted, rng)
        allowed = {(v.camera, v.frame) for v in seen.of_role("source")}
        given: list[SourceImage] = [s for s in sources if (s.camera, s.frame) in allowed]
        parts.append(render_pairs(wanted.kind, seen, scene, lidar, views, _truth(log, chunk, wanted, views), given))
    return joined(parts)


class _Scenes:
    """Reconstructions of a chunk, each from the source views that are left of it, made once."""

    def __init__(self, prepared: PreparedScene, recipe: PairRecipe) -> None:
        self._start, self._recipe, self._made = prepared.start, recipe, dict[tuple[Any, ...], Any]()

    def of(self, seen: Chunk, wanted: PairSet, rng: np.random.Generator) -> SceneGraph:
        import torch

        from genre_tasks.fixer.pairs import perturbed
        from genre_tasks.stages.gnet import gnet

        key = (wanted.loose, *((v.camera, v.frame) for v in seen.of_role("source")))
        if key not in self._made:
            config = GnetConfig(
                iterations=self._recipe.iterations, views_per_iteration=self._recipe.views,
                loss=LossConfig(perceptual=0.0), snapshots=6, constrain_ground=not wanted.loose,
            )
            self._made[key] = gnet(config, seen, self._start)
        made = self._made[key]
        if wanted.young:
            ages = sorted(k for k in made.snapshots if 0 < k <= self._recipe.iterations / 2)
            return made.snapshots[ages[int(rng.integers(len(ages)))]]
        if wanted.perturbed is None:
            return made.scene
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        return perturbed(made.scene, generator, float(rng.uniform(*wanted.perturbed)))


def _views(chunk: Chunk, wanted: PairSet, count: int, rng: np.random.Generator) -> tuple[Chunk, Sequence[NovelView]]:
    """The chunk with the source views that are left, and where it is rendered."""
    if wanted.at in ("beside", "side"):
        views = []
        for _ in range(count):
            shift_m = rng.choice(SHIFTS_M if wanted.at == "beside" else (SIDE_M,)) * rng.choice((-1, 1))
            poses = novel_view_poses(chunk, (float(shift_m),))
            views.append(poses[int(rng.integers(len(poses)))])
        return chunk, views
    if wanted.at == "camera":
        without = chunk.camera_names[int(rng.integers(len(chunk.camera_names)))]
        seen = _with_sources(chunk, lambda v: v.camera != without)
        rendered = [v for v in chunk.views if v.camera == without]
    else:
        frames = sorted({v.frame for v in chunk.of_role("source")})[:: wanted.keep_every]
        seen = _with_sources(chunk, lambda v: v.frame in frames)
        rendered = [v for v in chunk.views if v.frame not in frames]
    return seen, [_as_novel(v, seen.of_role("source")) for v in spread(rendered, count)]


def _with_sources(chunk: Chunk, keep: Any) -> Chunk:
    return replace(chunk, views=tuple(v for v in chunk.views if v.role != "source" or keep(v)))


def _as_novel(view: View, sources: Sequence[View]) -> NovelView:
    near = nearest_reference(view.camera, view.chunk_SE3_camera, sources)
    return NovelView(view.camera, view.frame, 0.0, view.chunk_SE3_camera, view.lens, (near.camera, near.frame))


def _truth(log: Any, chunk: Chunk, wanted: PairSet, views: Sequence[NovelView]) -> list[Any]:
    """The true images: ray-cast beside the path, else recorded."""
    from genre_tasks.scene.image_decoding import decode_pixels

    if wanted.at in ("beside", "side"):
        return [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    by = {(v.camera, v.frame): v for v in chunk.views}
    return [decode_pixels(by[v.camera, v.frame].image, v.lens.width_px, v.lens.height_px) for v in views]
