"""What is measured of the fixer on one log: GNet's renders beside the path before and after it.

On a synthetic log the ray-cast truth judges each view; on a real one the kernel distance to the chunk's real images.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.bench import Row
from benchmarks.common.context import threads
from benchmarks.common.novel_view_truth import TRUE_VIEWS, true_targets, views_at
from benchmarks.common.pipeline_inputs import Steps, steps_of
from benchmarks.common.scores import psnr_of
from benchmarks.common.task import SIDE_M
from benchmarks.optimiser.enhancement import BOOTSTRAP
from flows.pipeline.log_cache import opened_log
from flows.training.fixer_training import WEIGHTS, FixerJob
from genre_tasks.config import FnetConfig
from genre_tasks.fixer.network import Fnet
from genre_tasks.fixer.source_images import recorded
from genre_tasks.fixer.warping import MIN_ALPHA, SourceImage, surface_of, warp
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.metrics.distribution_distances import kernel_difference, kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED, FeatureSet, real_images
from genre_tasks.scene.chunk import Actor, Chunk
from genre_tasks.scene.novel_views import NovelView, NovelViews
from genre_tasks.stages.fnet import fix_views, load_configured, need
from genre_tasks.stages.novel_views import render_novel

KERNEL_SHIFTS_M = (1.0, 2.0, 3.0)
TIMED_RUNS = 3

GATE_SHIFTS_M, GATE_VIEWS = (0.25, 0.5, 1.0, 2.0, SIDE_M), 6
"""Where it is looked at whether views call for fixing, and how many views there."""

EVERYTHING = "render+reference+lidar"
ABLATIONS = ("render", "render+reference", "reference+lidar", EVERYTHING)
"""Which inputs a fixer is trained with: paper Table 3's rows src, src + ref, ref + LiDAR, and all."""


def measure_fixer(log: str, chunk: int, store: str, ablations: str) -> Row:
    """One cell: quality beside the path, flicker, what becomes of clean images, seconds a view, fewer inputs."""
    with threads():
        steps = steps_of(log, chunk, store, 0, enet=False)
        config = steps.config.fnet
        network = load_configured(config)
        out: Row = {"log": log, "chunk": chunk, "flicker": flicker_row(network, config, steps, log)}
        truth = true_targets(log, store, steps.chunk, SIDE_M)
        if truth:
            novel = _rendered(steps, views_at(steps.chunk, SIDE_M, TRUE_VIEWS))
            images = torch.stack([t.image.image for t in truth])
            out["truth"] = truth_row(network, config, steps.chunk, novel, images)
            loose = steps_of(log, chunk, store, 0, False, "gnet.constrain_ground=false")
            novel_loose = _rendered(loose, novel.views)
            out["loose"] = truth_row(network, config, steps.chunk, novel_loose, images)
            out["inputs"] = {
                inputs: inputs_row(load_fnet(path), config, steps.chunk, novel, images)
                for inputs, path in ablated(ablations).items()
            }
            out["gate"] = [gate_row(network, config, steps, log, store, shift) for shift in GATE_SHIFTS_M]
        else:
            real = real_images(steps.chunk)
            out["kernel"] = {
                f"{shift:g}": kernel_row(network, config, steps, views_at(steps.chunk, shift), real)
                for shift in KERNEL_SHIFTS_M
            }
        novel = _rendered(steps, views_at(steps.chunk, SIDE_M))
        return out | {"time": time_row(network, config, steps.chunk, novel)}


def _rendered(steps: Steps, views: Sequence[NovelView]) -> NovelViews:
    return render_novel(steps.chunk, steps.gnet, views, steps.config.novel_views.lidar_max_points)


@torch.no_grad()
def truth_row(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, truth: Tensor) -> Row:
    """PSNR (dB) and perceptual distance of each view to ``truth`` [V, H, W, 3]: the render, the fixed, the truth itself
    given as the render.
    """
    clean = replace(novel, color=truth, alpha=torch.ones_like(novel.alpha))
    images = {
        "render": novel.color.clamp(0, 1),
        "fixed": fix_views(network, config, chunk, novel).color,
        "clean": fix_views(network, config, chunk, clean).color,
    }
    distance = perceptual_distance()
    return {
        name: {"psnr": psnr_of(image, truth).tolist(), "perceptual": distance(image, truth).tolist()}
        for name, image in images.items()
    }


@torch.no_grad()
def gate_row(network: Fnet, config: FnetConfig, steps: Steps, log: str, store: str, shift_m: float) -> Row:
    """How much views near the path call for fixing, and their perceptual distance without and with it."""
    truth = true_targets(log, store, steps.chunk, shift_m, GATE_VIEWS)
    images = torch.stack([t.image.image for t in truth])
    novel = _rendered(steps, views_at(steps.chunk, shift_m, GATE_VIEWS))
    sources, distance = recorded(steps.chunk), perceptual_distance()
    fixed = fix_views(network, config.model_copy(update={"gate": 0.0}), steps.chunk, novel).color
    return {
        "shift": shift_m,
        "need": [need(steps.chunk, novel, i, sources) for i in range(len(novel.views))],
        "render": distance(novel.color.clamp(0, 1), images).tolist(),
        "fixed": distance(fixed, images).tolist(),
    }


def ablated(folder: str) -> dict[str, Path]:
    """Weights trained as long as each other with some of the inputs, where ``genre train fnet --inputs …`` puts them.

    From inputs, joined by "+", to the file; those that are not there are left out.
    """
    places = {inputs: FixerJob(folder, inputs=inputs).place / WEIGHTS for inputs in ABLATIONS}
    return {inputs: path for inputs, path in places.items() if path.is_file()}


@torch.no_grad()
def inputs_row(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, truth: Tensor) -> Row:
    """PSNR (dB) and perceptual distance of each fixed view, and seconds a view of the stage."""
    began = time.perf_counter()
    fixed = fix_views(network, config, chunk, novel).color
    seconds = (time.perf_counter() - began) / len(novel.views)
    perceptual = perceptual_distance()(fixed, truth).tolist()
    return {"psnr": psnr_of(fixed, truth).tolist(), "perceptual": perceptual, "seconds": seconds}


@torch.no_grad()
def kernel_row(network: Fnet, config: FnetConfig, steps: Steps, views: Sequence[NovelView], real: FeatureSet) -> Row:
    """Kernel distance of renders and fixed images to the real ones, and the difference with its paired interval."""
    novel, frames = _rendered(steps, views), [v.frame for v in views]
    fixed = fix_views(network, config, steps.chunk, novel).color
    before, after = (perceptual_distance().pooled_features(i) for i in (novel.color.clamp(0, 1), fixed))
    render = kernel_distance(before, real.features, frames, real.frames, bootstrap=0)
    less = kernel_difference(after, before, real.features, frames, frames, real.frames, BOOTSTRAP, BOOTSTRAP_SEED)
    assert render is not None and less is not None
    return {"n": len(views), "render": render.value, "difference": less.value, "low": less.low, "high": less.high}


@torch.no_grad()
def flicker_row(network: Fnet, config: FnetConfig, steps: Steps, log: str) -> Row:
    """Flicker of the first camera's renders and fixed images, and of the true ones, over the chunk's frames at a side.

    A sharp image differs more from its resampled neighbour than a blurred one: the truth's tells what that is worth.
    """
    chunk, truth = steps.chunk, opened_log(log).truth
    camera, actors = chunk.views[0].camera, chunk.actors
    views = sorted((v for v in views_at(chunk, SIDE_M) if v.camera == camera and v.shift_m > 0), key=lambda v: v.frame)
    novel = _rendered(steps, views)
    images = {"render": novel.color.clamp(0, 1), "fixed": fix_views(network, config, chunk, novel).color}
    if truth is not None:
        cast = [truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
        images["truth"] = torch.from_numpy(np.stack(cast).astype(np.float32) / np.float32(255))
    return {"frames": len(views)} | {name: flicker(image, novel, actors) for name, image in images.items()}


def flicker(images: Tensor, novel: NovelViews, actors: Sequence[Actor] = ()) -> float:
    """Mean absolute difference between each image [V, H, W, 3] and the next one, warped to it by rendered depth.

    ``novel``: the views, in the order of frames, with their depth. Points on actors move along. Where a point is out
    of the next image or hidden there it does not count.
    """
    total, count = 0.0, 0.0
    for k in range(len(images) - 1):
        view, after = novel.views[k], novel.views[k + 1]
        hides = torch.where(novel.alpha[k + 1] >= MIN_ALPHA, novel.depth[k + 1], torch.zeros_like(novel.depth[k + 1]))
        image = images[k + 1].permute(2, 0, 1)
        source = SourceImage(after.camera, after.frame, after.chunk_SE3_camera, after.lens, image, hides)
        surface = surface_of(novel.depth[k], novel.alpha[k], view.chunk_SE3_camera, view.lens, actors, view.frame)
        found = warp(surface, [source], actors, view.frame)
        total += float(((found.color - images[k].permute(2, 0, 1)).abs() * found.mask).sum())
        count += float(3 * found.mask.sum())
    return total / max(count, 1.0)


def time_row(network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews) -> Row:
    """Seconds of the whole stage but for loading the weights, of each run, ascending."""
    seconds = []
    for _ in range(TIMED_RUNS):
        began = time.perf_counter()
        fix_views(network, config, chunk, novel)
        seconds.append(time.perf_counter() - began)
    size = [int(x) for x in novel.color.shape[1:3]]
    return {"views": len(novel.views), "size": size, "batch": config.batch_views, "seconds": sorted(seconds)}
