"""GNet→FNet→ENet against GNet alone, and against GNet's network in ENet's place, at every shift.

On synthetic logs PSNR and perceptual distance to ray-cast truth; on real ones the kernel distance to all real images of
the chunk, over every frame and camera on both sides, with an interval of the paired difference over frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from benchmarks.common.bench import Row
from benchmarks.common.novel_view_truth import load_true_targets, views_at_shift
from benchmarks.common.pipeline_inputs import PipelineInputs, load_pipeline_inputs, render_images
from benchmarks.common.scores import psnr_per_view
from flows.training.optimiser_training import mean_psnr
from genre_tasks.config import OptimiserConfig, PipelineConfig
from genre_tasks.losses.targets import Target
from genre_tasks.metrics.distribution_distances import kernel_difference, kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED, FeatureSet, real_image_features
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.stages.optimise import method_for
from genre_tasks.weights import resolve_weights

SHIFTS_M = (1.0, 2.0, 3.0, 4.0, 5.0)
BOOTSTRAP = 400

Scenes = Mapping[str, SceneGraph]
"""``gnet``, and what enhanced it: ``enet``, and ``gnet_again``."""


def measure_enhancement(log: str, chunk: int, store: str, order: int, settings: Sequence[str] = ()) -> Row:
    """Measures the three scenes on held-out frames and at every shift.

    Args:
        log: URI.
        chunk: index in the log.
        store: folder of the artifacts.
        order: seed of the order of views.
        settings: over the preset ``small``.

    Returns:
        The row of the cell.
    """
    steps = load_pipeline_inputs(log, chunk, store, order, True, *settings)
    assert steps.enet is not None
    scenes = {"gnet": steps.gnet, "enet": steps.enet, "gnet_again": enhance_with_gnet(steps)}
    shifts = {}
    for shift in SHIFTS_M:
        truth = load_true_targets(log, store, steps.chunk, shift)
        # Every view on real logs: a kernel distance of few images has a wide interval.
        views = views_at_shift(steps.chunk, shift)
        shifts[f"{shift:g}"] = (
            score_against_truth(scenes, truth)
            if truth
            else score_as_sets(scenes, views, real_image_features(steps.chunk))
        )
    heldout = {name: mean_psnr(scene, steps.heldout) for name, scene in scenes.items()}
    return {"log": log, "chunk": chunk, "order": order, "heldout_psnr": heldout, "shifts": shifts}


def gnet_as_enhancer(config: PipelineConfig) -> OptimiserConfig:
    """Puts GNet's network in ENet's place.

    Args:
        config: of the pipeline.

    Returns:
        ENet's section with GNet's weights, length and source views, and as many fixed views.
    """
    # A preset's learning rates are for the weights that they were swept for; GNet's weights bring their own.
    views = config.gnet.views_per_iteration
    gnet = {"iterations": config.gnet.iterations, "views_per_iteration": views, "novel_views_per_iteration": views}
    return config.enet.model_copy(
        update=gnet | {"weights": str(resolve_weights("gnet", config.gnet.weights)), "learning_rates": None}
    )


def enhance_with_gnet(steps: PipelineInputs) -> SceneGraph:
    """Enhances GNet's scene with GNet's network on the fixed images.

    Args:
        steps: results of the pipeline's stages.

    Returns:
        SceneGraph: at the end.
    """
    config = gnet_as_enhancer(steps.config)
    return method_for("enet", config).run(steps.gnet, steps.source, steps.fixed).scene


def score_against_truth(scenes: Scenes, truth: Sequence[Target]) -> Row:
    """Scores scenes against true images.

    Args:
        scenes: by name.
        truth: views with their true images.

    Returns:
        Mean PSNR in dB and mean perceptual distance of each scene.
    """
    images = torch.stack([t.image.pixels for t in truth])
    out: Row = {"n": len(truth)}
    for name, scene in scenes.items():
        rendered = render_images(scene, truth)
        # Without this the network of the distance could keep its activations for a backward pass.
        with torch.no_grad():
            perceptual = perceptual_distance()(rendered, images)
        out[name] = {"psnr": float(psnr_per_view(rendered, images).mean()), "perceptual": float(perceptual.mean())}
    return out


def score_as_sets(scenes: Scenes, views: Sequence[NovelView], real: FeatureSet) -> Row:
    """Scores scenes as sets of renders, where there is no true image to compare a render with.

    Args:
        scenes: by name; ``gnet`` is what the others are compared with.
        views: to render.
        real: features of the real images.

    Returns:
        Kernel distance of each scene's renders to the real images, and the difference to GNet's with its interval.
    """
    frames = [v.frame for v in views]
    features = {name: perceptual_distance().pooled_features(render_images(s, views)) for name, s in scenes.items()}
    out: Row = {"n": len(views)}
    for name, rendered in features.items():
        found = kernel_distance(rendered, real.features, frames, real.frames, bootstrap=0)
        assert found is not None
        out[name] = {"kernel": found.value}
        if name != "gnet":
            before = features["gnet"]
            # Frames are resampled for both scenes together: the paired interval is narrower than two single ones.
            less = kernel_difference(
                rendered, before, real.features, frames, frames, real.frames, BOOTSTRAP, BOOTSTRAP_SEED
            )
            assert less is not None
            out[name] |= {"difference": less.value, "low": less.low, "high": less.high}
    return out
