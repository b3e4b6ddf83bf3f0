"""What is measured of the fixer on one log: GNet's renders beside the path before and after it.

On a synthetic log the ray-cast truth is what views are compared with; on a real one the kernel distance to the chunk's
real images.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.common.bench import Row
from benchmarks.common.context import THREADS
from benchmarks.common.novel_view_truth import TRUE_VIEWS, load_true_targets, views_at_shift
from benchmarks.common.pipeline_inputs import PipelineInputs, load_pipeline_inputs
from benchmarks.common.scores import psnr_per_view
from benchmarks.common.task import SIDE_M
from benchmarks.fixer.flicker import measure_flicker
from benchmarks.optimiser.enhancement import BOOTSTRAP
from flows.training.fixer_job import WEIGHTS_FILE, FixerJob
from genre_tasks.config import FnetConfig
from genre_tasks.fixer.network import Fnet
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.metrics.distribution_distances import kernel_difference, kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED, FeatureSet, real_image_features
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import NovelView, NovelViews
from genre_tasks.stages.fnet import estimate_need, fix_views, load_configured_fnet
from genre_tasks.stages.novel_views import render_novel
from genre_tasks.threads import torch_threads

KERNEL_SHIFTS_M = (1.0, 2.0, 3.0)
GATE_VIEWS = 6
"""Number of views at each shift of which it is measured whether they need fixing."""

ALL_INPUTS = "render+reference+lidar"
ABLATIONS = ("render", "render+reference", "reference+lidar", ALL_INPUTS)
"""Which inputs a fixer is trained with: paper Table 3's rows src, src + ref, ref + LiDAR, and all."""


@dataclass(frozen=True)
class FixerCase:
    """What one cell measures.

    Attributes:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store.
        ablations: folder of fixers that were trained with fewer inputs.
        gate_shifts_m: shifts at which it is measured whether views need fixing, metres.
        timed_runs: how often the stage is timed.
        settings: ``section.key=value`` over the preset ``small``.
    """

    log: str
    chunk: int
    store: str
    ablations: str
    gate_shifts_m: tuple[float, ...]
    timed_runs: int
    settings: tuple[str, ...] = ()

    def inputs(self, *settings: str) -> PipelineInputs:
        """Runs the pipeline up to FNet, with further settings over the preset."""
        return load_pipeline_inputs(self.log, self.chunk, self.store, 0, False, *self.settings, *settings)

    def true_images(self, chunk: Chunk, shift_m: float, count: int) -> Tensor | None:
        """Gives ray-cast images [V, H, W, 3] at a shift; ``None`` where the log has no truth."""
        targets = load_true_targets(self.log, self.store, chunk, shift_m, count)
        return torch.stack([t.image.pixels for t in targets]) if targets else None


def measure_fixer(case: FixerCase) -> Row:
    """Measures one cell.

    Args:
        case: what to measure.

    Returns:
        A row: ``flicker`` and ``time``; with a truth ``truth``, ``loose`` (the same of a scene whose ground is not
        constrained), ``inputs`` and ``gate``; without it ``kernel``.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    with torch_threads(THREADS):
        # The pipeline runs inside the block, so that its stages have as many threads as the timing below.
        inputs = case.inputs()
        config = inputs.config.fnet
        network = load_configured_fnet(config)
        row: Row = {"log": case.log, "chunk": case.chunk}
        row["flicker"] = measure_flicker(network, config, inputs, case.log)
        truth = case.true_images(inputs.chunk, SIDE_M, TRUE_VIEWS)
        if truth is not None:
            row |= _measure_against_truth(network, case, inputs, truth)
        else:
            real = real_image_features(inputs.chunk)
            row["kernel"] = {
                f"{shift:g}": measure_kernel(network, config, inputs, views_at_shift(inputs.chunk, shift), real)
                for shift in KERNEL_SHIFTS_M
            }
        # All views at this shift and not a sample: batches have to be full, as in use.
        novel = render_views_for_fixer(inputs, views_at_shift(inputs.chunk, SIDE_M))
        return row | {"time": measure_seconds(network, config, inputs.chunk, novel, case.timed_runs)}


def _measure_against_truth(network: Fnet, case: FixerCase, inputs: PipelineInputs, truth: Tensor) -> Row:
    config = inputs.config.fnet
    novel = render_views_for_fixer(inputs, views_at_shift(inputs.chunk, SIDE_M, TRUE_VIEWS))
    # A scene with a worse road shows whether the fixer repairs what the optimiser would otherwise prevent.
    unconstrained = case.inputs("gnet.constrain_ground=false")
    novel_unconstrained = render_views_for_fixer(unconstrained, novel.views)
    return {
        "truth": compare_with_truth(network, config, inputs.chunk, novel, truth),
        "loose": compare_with_truth(network, config, inputs.chunk, novel_unconstrained, truth),
        # The same renders for every fixer: only their inputs differ.
        "inputs": {
            name: score_ablation(load_fnet(path), config, inputs.chunk, novel, truth)
            for name, path in find_ablation_weights(case.ablations).items()
        },
        "gate": [measure_gate(network, case, inputs, shift) for shift in case.gate_shifts_m],
    }


def render_views_for_fixer(inputs: PipelineInputs, views: Sequence[NovelView]) -> NovelViews:
    """Renders GNet's scene with all that the fixer reads: colours, depths and LiDAR maps.

    Args:
        inputs: the scene and its chunk.
        views: V of one size.

    Returns:
        Colours, depths and LiDAR maps of the views.
    """
    return render_novel(inputs.chunk, inputs.gnet, views, inputs.config.novel_views.lidar_max_points)


@torch.no_grad()
def compare_with_truth(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, truth: Tensor) -> Row:
    """Compares renders, fixed images, and what the fixer makes of true images with the truth.

    Args:
        network: the fixer.
        config: of its stage.
        chunk: the source images.
        novel: V renders.
        truth: [V, H, W, 3] sRGB in [0, 1].

    Returns:
        PSNR (dB) and perceptual distance of each view, for ``render``, ``fixed`` and ``clean``: the truth itself given
        as the render, which a fixer should leave alone.
    """
    # Depth stays the render's, because the warped references need one and the truth has none.
    # A true image has no holes, so that its alpha is 1 everywhere.
    clean = replace(novel, color=truth, alpha=torch.ones_like(novel.alpha))
    images = {
        "render": novel.color.clamp(0, 1),
        "fixed": fix_views(network, config, chunk, novel).color,
        "clean": fix_views(network, config, chunk, clean).color,
    }
    distance = perceptual_distance()
    return {
        name: {"psnr": psnr_per_view(image, truth).tolist(), "perceptual": distance(image, truth).tolist()}
        for name, image in images.items()
    }


@torch.no_grad()
def measure_gate(network: Fnet, case: FixerCase, inputs: PipelineInputs, shift_m: float) -> Row:
    """Measures how much views near the path need fixing, and what fixing all of them does.

    Args:
        network: the fixer.
        case: names the log and the store.
        inputs: the scene and its chunk.
        shift_m: metres to both sides of the path.

    Returns:
        Of each view the estimated need and the perceptual distance without and with fixing.
    """
    # Few views at each shift, because each is ray-cast.
    truth = case.true_images(inputs.chunk, shift_m, GATE_VIEWS)
    assert truth is not None  # the cell has a truth at other shifts
    novel = render_views_for_fixer(inputs, views_at_shift(inputs.chunk, shift_m, GATE_VIEWS))
    # Loaded once: decoding all sources for each view would take longer than the estimate.
    sources = load_source_images(inputs.chunk)
    distance = perceptual_distance()
    # With a gate of 0 every view is fixed: what the gate would have left out is seen, too.
    ungated = inputs.config.fnet.model_copy(update={"gate": 0.0})
    fixed = fix_views(network, ungated, inputs.chunk, novel).color
    return {
        "shift": shift_m,
        "need": [estimate_need(inputs.chunk, novel, i, sources) for i in range(len(novel.views))],
        "render": distance(novel.color.clamp(0, 1), truth).tolist(),
        "fixed": distance(fixed, truth).tolist(),
    }


def find_ablation_weights(folder: str) -> dict[str, Path]:
    """Finds weights that were trained equally long with some of the inputs.

    Args:
        folder: where ``genre train fnet --inputs …`` puts them.

    Returns:
        Inputs, joined by "+" → the file; those that are not there are left out.

    >>> find_ablation_weights("nowhere")
    {}
    """
    # The training decides where its weights go, so its job is asked.
    files = {inputs: FixerJob(folder, inputs=inputs).run_folder / WEIGHTS_FILE for inputs in ABLATIONS}
    return {inputs: path for inputs, path in files.items() if path.is_file()}


@torch.no_grad()
def score_ablation(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, truth: Tensor) -> Row:
    """Scores a fixer that was trained with some of the inputs.

    Args:
        network: the fixer.
        config: of its stage.
        chunk: the source images.
        novel: V renders.
        truth: [V, H, W, 3] sRGB in [0, 1].

    Returns:
        PSNR (dB) and perceptual distance of each fixed view, and seconds a view of the stage.
    """
    began = time.perf_counter()
    fixed = fix_views(network, config, chunk, novel).color
    # The distance below is not the fixer's work, so the clock is read before it.
    seconds = (time.perf_counter() - began) / len(novel.views)
    perceptual = perceptual_distance()(fixed, truth).tolist()
    return {"psnr": psnr_per_view(fixed, truth).tolist(), "perceptual": perceptual, "seconds": seconds}


@torch.no_grad()
def measure_kernel(
    network: Fnet, config: FnetConfig, inputs: PipelineInputs, views: Sequence[NovelView], real: FeatureSet
) -> Row:
    """Measures the kernel distance of renders and of fixed images to the real ones.

    Args:
        network: the fixer.
        config: of its stage.
        inputs: the scene and its chunk.
        views: to render.
        real: features of the chunk's real images.

    Returns:
        The render's distance, the fixed images' difference to it, and the difference's paired interval over frames.
    """
    novel = render_views_for_fixer(inputs, views)
    fixed = fix_views(network, config, inputs.chunk, novel).color
    frames = [v.frame for v in views]
    extract = perceptual_distance().pooled_features
    before = extract(novel.color.clamp(0, 1))
    after = extract(fixed)
    # Only the difference needs an interval, and resampling is slow.
    render = kernel_distance(before, real.features, frames, real.frames, bootstrap=0)
    # Paired over frames: the two distances share their views, and single intervals would be far too wide.
    difference = kernel_difference(after, before, real.features, frames, frames, real.frames, BOOTSTRAP, BOOTSTRAP_SEED)
    assert render is not None and difference is not None  # a chunk has more than one frame
    return {
        "n": len(views),
        "render": render.value,
        "difference": difference.value,
        "low": difference.low,
        "high": difference.high,
    }


def measure_seconds(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, runs: int = 3) -> Row:
    """Times the stage, except for loading the weights.

    Args:
        network: the fixer.
        config: of its stage.
        chunk: the source images.
        novel: renders to fix.
        runs: how often.

    Returns:
        Number and size of the views, the batch, and the seconds of each run, ascending.
    """
    seconds = []
    # Several runs, because the first one also allocates and fills caches.
    for _ in range(runs):
        began = time.perf_counter()
        fix_views(network, config, chunk, novel)
        seconds.append(time.perf_counter() - began)
    size = [int(x) for x in novel.color.shape[1:3]]
    return {"views": len(novel.views), "size": size, "batch": config.batch_views, "seconds": sorted(seconds)}
