"""The recipes behind the shipped weights of GNet and ENet: which scenes, in which order, for how many steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from flows.train.optimiser import AGES, network_from, train_optimiser, train_scenes
from flows.train.scenes import PreparedScene, SceneRecipe, prepare, training_scene
from genre_tasks.config import FnetConfig, LossConfig, NovelViewsConfig, OptimiserConfig
from genre_tasks.optimiser.adam import ENET_RATES, GNET_RATES
from genre_tasks.optimiser.episodes import TrainingScene
from genre_tasks.optimiser.learned import LearnedOptimiser, NetworkConfig
from genre_tasks.optimiser.ssim import blur
from genre_tasks.optimiser.training import MetaConfig
from genre_tasks.progress import Progress, silent
from genre_tasks.render import render_views
from genre_tasks.scene.results import Reconstruction
from genre_tasks.scene.views import FixedViews
from genre_tasks.stages.fnet import fnet
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.novel_views import novel_views
from storage.local import LocalStore

CAMERAS = (3, 3, 3, 6, 3, 3, 2, 3)
COARSE_POINTS, FINE_POINTS = (6_000, 8_000, 5_000, 10_000), (18_000, 20_000, 14_000, 24_000)

GNET_LOSS = LossConfig(perceptual=0.0)
"""What the optimiser sees in GNet's training."""
GNET_JUDGE = LossConfig(perceptual=0.0, depth=0.0, novel=0.1)
"""What judges it: held-out frames, and true novel views with λ_novel = 0.1 (paper Sec. III-D)."""
STAND_IN_TRUTH = 0.6
ENET_LOSS = LossConfig(perceptual=0.02, perceptual_every=2)
ENET_JUDGE = LossConfig(perceptual=0.05, perceptual_every=1, depth=0.0)


@dataclass(frozen=True)
class Stage:
    """A stage of a training: its folder, whether at 320×180, weight updates, their rate, the seed.

    ``judged`` weighs the unseen views, ``views`` are drawn in an iteration, ``more_real`` doubles the real log's part.
    """

    name: str
    fine: bool
    steps: int
    rate: float
    seed: int
    judged: float = 1.0
    views: tuple[int, ...] = (4, 6, 6, 8)
    more_real: bool = False


GNET_STAGES = (
    Stage("coarse", False, 1200, 2.5e-3, 0),
    Stage("fine", True, 240, 5e-4, 1),
    Stage("finer", True, 240, 5e-4, 2),
    Stage("unseen", True, 200, 7e-4, 3, judged=4.0),
    Stage("many", True, 110, 6e-4, 4, judged=4.0, views=(6, 15, 30), more_real=True),
)
ENET_STAGES = (
    Stage("coarse", False, 300, 1e-3, 0, judged=2.0, views=(4, 6, 6)),
    Stage("fine", True, 160, 5e-4, 1, judged=2.0, views=(4, 6, 6)),
)
ENET_COARSE = 24
ENET_CONFIG = MetaConfig(
    pool=5,
    iterations=(8, 12, 12, 16),
    novel_views=6,
    log_scale_spread=0.0,
    logit_spread=0.0,
    loss=ENET_LOSS,
    judge_loss=ENET_JUDGE,
)


def coarse_scenes(count: int = 40, real: str | None = None) -> list[SceneRecipe]:
    """Streets at 160×90, a quarter of the pixels and Gaussians: four times as many steps in the same time."""
    sizes: dict[str, Any] = {"distant_count": 800, "width_px": 160, "height_px": 90}
    out = []
    if real is not None:
        dense = {**sizes, "distant_count": 1_500}
        out = 2 * [SceneRecipe(real, max_points=6_000, **sizes), SceneRecipe(real, max_points=12_000, **dense)]
    for k in range(count):
        uri = _street((k * 37 + 11) % 900, k, "&width=160&height=90")
        out.append(SceneRecipe(uri, max_points=COARSE_POINTS[k % 4], novel_every=1, **sizes))
    return out


def fine_scenes(count: int = 15, real: str | None = None) -> list[SceneRecipe]:
    """Streets at 320×180."""
    out = []
    if real is not None:
        out = [SceneRecipe(real, max_points=18_000), SceneRecipe(real, max_points=36_000, distant_count=4_000)]
    return out + [SceneRecipe(_street(k * 37 % 900, k), max_points=FINE_POINTS[k % 4]) for k in range(count)]


def train_gnet(
    store: LocalStore,
    folder: Path,
    real: str | None = None,
    progress: Progress = silent,
    novel: float = GNET_JUDGE.novel,
) -> LearnedOptimiser:
    """GNet from nothing, in the stages of ``GNET_STAGES``; each resumes. ``real``: the URI of a log with a chunk 0.

    ``novel``: λ_novel; 0 trains on recorded views alone, as G3R.
    """
    judge = GNET_JUDGE.model_copy(update={"novel": novel})
    network = network_from(NetworkConfig(rates=GNET_RATES), seed=0)
    for stage in GNET_STAGES:
        recipes = fine_scenes(real=real) if stage.fine else coarse_scenes(real=real)
        recipes = [r for r in recipes if stage.more_real and r.uri == real] + recipes
        scenes = [training_scene(prepare(store, r)) for r in recipes]
        config = MetaConfig(pool=6, loss=GNET_LOSS, judge_loss=judge)
        train_optimiser(network, scenes, _at(config, stage), folder / stage.name, progress=progress)
    return network


def train_enet(
    store: LocalStore, folder: Path, gnet_folder: Path, real: str | None = None, progress: Progress = silent
) -> LearnedOptimiser:
    """ENet from GNet's weights after their coarse stage, at ENet's rates, on scenes that GNet or tuned Adam made.

    First at 160×90 on streets with stand-ins for FNet's images (see :func:`stand_in_views`), then at 320×180 with
    FNet's images, on the real log too. ``gnet_folder`` is where :func:`train_gnet` trained.
    """
    from genre_tasks.metrics.perceptual import perceptual_distance

    network = network_from(NetworkConfig(rates=ENET_RATES), 0, gnet_folder / "coarse" / "weights.safetensors")
    for stage in ENET_STAGES:
        recipes = fine_scenes(real=real) if stage.fine else coarse_scenes(ENET_COARSE)
        made_by = gnet_folder / stage.name / "weights.safetensors"
        prepared = [prepare(store, r) for r in recipes]
        scenes = enet_scenes(prepared, made_by, fixed_views if stage.fine else stand_in_views)
        config = _at(ENET_CONFIG, stage)
        train_optimiser(network, scenes, config, folder / stage.name, perceptual_distance(), progress=progress)
    return network


def enet_scenes(
    prepared: Sequence[PreparedScene],
    gnet_weights: Path,
    fix: Callable[[PreparedScene, Reconstruction], FixedViews],
) -> list[TrainingScene]:
    """Two of three scenes as GNet leaves them, the others as tuned Adam does at several ages, with fixed views."""
    config = OptimiserConfig(loss=GNET_LOSS, weights=str(gnet_weights), snapshots=0)
    aged = train_scenes([p for k, p in enumerate(prepared) if k % 3 == 2], AGES)
    out = []
    for k, scene in enumerate(prepared):
        start = aged[k // 3] if k % 3 == 2 else gnet(config.model_copy(update={"seed": k}), scene.chunk, scene.start)
        out.append(training_scene(scene, start, fix(scene, start)))
    return out


def fixed_views(scene: PreparedScene, start: Reconstruction) -> FixedViews:
    """FNet's images of the scene at ±3 m; on a street, of the views whose true image is not kept to judge."""
    rendered = novel_views(NovelViewsConfig(lidar_max_points=40_000), scene.chunk, start)
    fixed = fnet(FnetConfig(), scene.chunk, rendered)
    if scene.truth is None:
        return fixed
    judged = {(v.camera, v.frame, v.shift_m) for v in scene.truth.views}
    kept = [i for i, v in enumerate(fixed.views) if (v.camera, v.frame, v.shift_m) not in judged]
    return replace(fixed, views=tuple(fixed.views[i] for i in kept), color=fixed.color[torch.tensor(kept)])


def stand_in_views(scene: PreparedScene, start: Reconstruction) -> FixedViews:
    """What stands in for FNet's images before FNet is trained: true images, blurred and mixed with the render.

    Every other view of a street's truth is taken; the views between them remain to judge.
    """
    assert scene.truth is not None
    views = scene.truth.views[::2]
    with torch.no_grad():
        render = render_views(start.scene, views).color.clamp(0, 1)
    truth = torch.stack([blur(image) for image in scene.truth.color[::2]])
    return FixedViews(views, STAND_IN_TRUTH * truth + (1 - STAND_IN_TRUTH) * render)


def _at(config: MetaConfig, stage: Stage) -> MetaConfig:
    """The configuration of a stage."""
    of_stage = ("steps", "rate", "seed", "judged", "views")
    return config.model_copy(update={name: getattr(stage, name) for name in of_stage})


def _street(seed: int, k: int, more: str = "") -> str:
    cameras = CAMERAS[k % len(CAMERAS)]
    return f"synthetic:street?seed={seed}{more}" + (f"&cameras={cameras}" if cameras != 3 else "")
