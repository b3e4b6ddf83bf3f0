"""The scenes that rates are tuned on: GNet's initial scenes, or GNet's scenes with FNet's images for ENet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.common.novel_view_truth import load_true_targets, views_at_shift
from benchmarks.common.pipeline_inputs import load_pipeline_inputs
from benchmarks.common.task import HELDOUT_VIEWS, SIDE_M, OptimisationTask
from benchmarks.optimiser.distillation import KERNEL_VIEWS
from benchmarks.optimiser.distillation_scores import NovelViewScorer
from flows.configuration import load_configuration
from flows.training.training_scenes import SceneRecipe, build_training_scene, evenly_spaced, prepare_scene
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.metrics.scoring import real_image_features
from genre_tasks.scene.graph import SceneGraph
from storage.local import LocalStore


@dataclass(frozen=True)
class TuningScene:
    """A scene that a setting is scored on.

    Attributes:
        scene: to optimise, with its views.
        split: fraction of Gaussians that are split first.
        closeness: dB of a result that are added to its PSNR; ``None``: nothing is added.
    """

    scene: TrainingScene
    split: float = 0.0
    closeness: Callable[[SceneGraph], float] | None = None


def scene_uris(seeds: Sequence[int], real: str | None) -> dict[int | str, str]:
    """Lists the logs of a sweep.

    Args:
        seeds: of synthetic streets.
        real: URI of a log whose chunk 0 counts as one more scene; ``None``: none does.

    Returns:
        URIs by seed; the real log's name is ``real``.

    >>> scene_uris([900], "pandaset:data/002")
    {900: 'synthetic:street?seed=900', 'real': 'pandaset:data/002'}
    """
    uris: dict[int | str, str] = {seed: f"synthetic:street?seed={seed}" for seed in seeds}
    return uris | ({} if real is None else {"real": real})


def load_gnet_scene(store: LocalStore, points: int, uri: str) -> TuningScene:
    """Loads GNet's task: an initial scene at 320×180, with all source views and twelve held-out ones.

    Args:
        store: artifacts of the sweep.
        points: LiDAR points at most; a tenth as many Gaussians are distant.
        uri: of the log.

    Returns:
        TuningScene: without a split.
    """
    recipe = SceneRecipe(uri, max_points=points, distant_count=points // 10)
    return TuningScene(build_training_scene(prepare_scene(store, recipe)))


def load_enet_scene(store: str, split: float | None, uri: str) -> TuningScene:
    """Loads ENet's task: GNet's scene and FNet's images in the preset ``small``.

    Args:
        store: folder of the sweep's artifacts.
        split: fraction of Gaussians to split; ``None``: the preset's.
        uri: of the log.

    Returns:
        TuningScene: its closeness is the kernel distance at 3 m, in dB.
    """
    split = load_configuration("small").enet.split_fraction if split is None else split
    steps = load_pipeline_inputs(uri, 0, store, 0, enet=False)
    heldout = evenly_spaced(steps.heldout, HELDOUT_VIEWS)
    truth = load_true_targets(uri, store, steps.chunk, SIDE_M)
    scene = TrainingScene(uri, steps.gnet, steps.source, heldout, steps.fixed, truth)
    task = OptimisationTask(steps.gnet, steps.source, heldout, truth)
    scorer = NovelViewScorer(views_at_shift(steps.chunk, SIDE_M, KERNEL_VIEWS), real_image_features(steps.chunk), task)
    return TuningScene(scene, split, partial(kernel_db, scorer))


def kernel_db(scorer: NovelViewScorer, scene: SceneGraph) -> float:
    """Expresses the kernel distance at 3 m to the real images in dB, so that it can be added to a PSNR.

    Args:
        scorer: with the views and the real images.
        scene: to score.

    Returns:
        dB, higher is better: a tenth less distance is half a decibel.
    """
    # The unbiased estimate may fall to zero or below, where there is no logarithm.
    return -10 * math.log10(max(scorer.score(scene, 0.0, 0).kernel, 1e-3))
