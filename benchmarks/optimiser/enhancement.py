"""GNet→FNet→ENet beside GNet alone, and beside GNet's network in ENet's place, at every shift.

On synthetic logs PSNR and perceptual distance to ray-cast truth; on real ones the kernel distance to all real images of
the chunk, over every frame and camera on both sides, with an interval of the paired difference over frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from benchmarks.common.bench import Row
from benchmarks.common.novel_view_truth import true_targets, views_at
from benchmarks.common.pipeline_inputs import Steps, images_of, steps_of
from benchmarks.common.scores import mean_psnr, psnr_of
from genre_tasks.config import OptimiserConfig, PipelineConfig
from genre_tasks.losses.targets import Target
from genre_tasks.metrics.distribution_distances import kernel_difference, kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED, FeatureSet, real_images
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.unroll import unroll
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.stages.optimise import distance, plan_of, step_rule
from genre_tasks.weights import resolve_weights

SHIFTS_M = (1.0, 2.0, 3.0, 4.0, 5.0)
BOOTSTRAP = 400

Scenes = Mapping[str, SceneGraph]
"""``gnet``, and what enhanced it: ``enet``, and ``gnet_again``."""


def measure_enhancement(log: str, chunk: int, store: str, order: int) -> Row:
    """One cell: the three scenes on held-out frames and at every shift."""
    steps = steps_of(log, chunk, store, order, enet=True)
    assert steps.enet is not None
    scenes = {"gnet": steps.gnet, "enet": steps.enet, "gnet_again": enhanced_by_gnet(steps)}
    shifts = {}
    for shift in SHIFTS_M:
        truth = true_targets(log, store, steps.chunk, shift)
        views = views_at(steps.chunk, shift)
        shifts[f"{shift:g}"] = (
            against_truth(scenes, truth) if truth else as_sets(scenes, views, real_images(steps.chunk))
        )
    heldout = {name: mean_psnr(scene, steps.heldout) for name, scene in scenes.items()}
    return {"log": log, "chunk": chunk, "order": order, "heldout_psnr": heldout, "shifts": shifts}


def as_enhancer(config: PipelineConfig) -> OptimiserConfig:
    """ENet's section with GNet's weights at their own rates, its T and source views, and as many fixed views."""
    views = config.gnet.views_per_iteration
    own = {"iterations": config.gnet.iterations, "views_per_iteration": views, "novel_views_per_iteration": views}
    return config.enet.model_copy(
        update=own | {"weights": str(resolve_weights("gnet", config.gnet.weights)), "learning_rates": None}
    )


def enhanced_by_gnet(steps: Steps) -> SceneGraph:
    """GNet's network on the same fixed images, from the same scene."""
    config = as_enhancer(steps.config)
    rule, objective = step_rule("enet", config), Objective(config.loss, distance(config))
    return unroll(rule, steps.gnet, steps.source, steps.fixed, objective, plan_of("enet", config)).scene


def against_truth(scenes: Scenes, truth: Sequence[Target]) -> Row:
    """Mean PSNR (dB) and perceptual distance of each scene at the true views."""
    images = torch.stack([t.image.image for t in truth])
    out: Row = {"n": len(truth)}
    for name, scene in scenes.items():
        rendered = images_of(scene, truth)
        with torch.no_grad():
            perceptual = perceptual_distance()(rendered, images)
        out[name] = {"psnr": float(psnr_of(rendered, images).mean()), "perceptual": float(perceptual.mean())}
    return out


def as_sets(scenes: Scenes, views: Sequence[NovelView], real: FeatureSet) -> Row:
    """Kernel distance of each scene's renders to the real images, and of the enhanced ones the difference to GNet's."""
    frames = [v.frame for v in views]
    features = {name: perceptual_distance().pooled_features(images_of(s, views)) for name, s in scenes.items()}
    out: Row = {"n": len(views)}
    for name, own in features.items():
        found = kernel_distance(own, real.features, frames, real.frames, bootstrap=0)
        assert found is not None
        out[name] = {"kernel": found.value}
        if name != "gnet":
            before = features["gnet"]
            less = kernel_difference(own, before, real.features, frames, frames, real.frames, BOOTSTRAP, BOOTSTRAP_SEED)
            assert less is not None
            out[name] |= {"difference": less.value, "low": less.low, "high": less.high}
    return out
