"""What an effect is judged by. More is better; arguments are the chunk as planned, a scene, and the truth if any."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from genre_tasks.effects.anti_aliasing import ratios
from genre_tasks.effects.nonrigid_actors import covered
from genre_tasks.logs.types import Float32, Truth
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.scoring import true_pixels, view_image
from genre_tasks.render.api import render_views
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_depth import lidar_depth
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.visibility import visible
from genre_tasks.stages.evaluate import as_recorded

SIDE_M = 3.0
APART = 2.0


def heldout_psnr(chunk: Chunk, scene: SceneGraph, _: Truth | None = None) -> float:
    """Mean over held-out views, as the cameras recorded them, outside of the vehicle itself, dB.

    Where the vehicle is in a camera's images, of such cameras alone.
    """
    masked = {v.camera for v in chunk.views if v.own is not None}
    return _mean_psnr(scene, [v for v in chunk.of_role("heldout") if not masked or v.camera in masked])


def every_heldout_psnr(chunk: Chunk, scene: SceneGraph, _: Truth | None = None) -> float:
    """As :func:`heldout_psnr`, of all cameras in any case."""
    return _mean_psnr(scene, chunk.of_role("heldout"))


def _mean_psnr(scene: SceneGraph, views: Sequence[View]) -> float:
    out = []
    for view in views:
        with torch.no_grad():
            image = as_recorded(render_views(scene, [view]).color, [view]).clamp(0, 1)[0]
        out.append(psnr(image.numpy(), view_image(view).numpy(), None if view.own is None else ~view.own))
    return float(np.mean(out))


def heldout_people(chunk: Chunk, scene: SceneGraph, _: Truth | None = None) -> float:
    """PSNR over all that boxes of pedestrians and cyclists cover of held-out views, dB; of whole views where none do.

    Whole images hardly see them: a few per cent of the pixels.
    """
    error, count = 0.0, 0
    for view in chunk.of_role("heldout"):
        with torch.no_grad():
            image = as_recorded(render_views(scene, [view]).color, [view]).clamp(0, 1)[0]
        own = covered(chunk, view)
        error += float(np.square(image.numpy() - view_image(view).numpy()).mean(-1)[own].sum(dtype=np.float64))
        count += int(own.sum())
    return -10 * math.log10(error / count) if count else heldout_psnr(chunk, scene)


def heldout_depth(chunk: Chunk, scene: SceneGraph, _: Truth | None = None) -> float:
    """Minus the median relative error of depth in per cent, against the LiDAR returns of held-out frames."""
    errors = []
    for view in chunk.of_role("heldout"):
        with torch.no_grad():
            depth = render_views(scene, [view]).expected_depth()[0]
        true = lidar_depth(chunk, view)
        known = (true > 0) & (depth > 0)
        errors.append((depth[known] / true[known] - 1).abs())
    return -100 * float(torch.cat(errors).median())


def beside_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """Mean at ±3 m against what an ideal camera would have seen, dB; held-out frames where there is no truth."""
    if truth is None:
        return heldout_psnr(chunk, scene)
    return _ideal_psnr(chunk, scene, truth, novel_view_poses(chunk, (SIDE_M, -SIDE_M)))


def apart_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """PSNR at ±3 m over pixels that show a LiDAR return whose footprints in the views are more than twice apart, dB.

    Without a truth: of held-out frames.
    """
    if truth is None:
        return _apart(chunk, scene, [(v, view_image(v).numpy()) for v in chunk.of_role("heldout")])
    ideal = []
    for v in novel_view_poses(chunk, (SIDE_M, -SIDE_M)):
        true = true_pixels(chunk, truth, v).astype(np.float32) / np.float32(255)
        ideal.append((View(v.camera, v.frame, "heldout", 0.0, v.chunk_SE3_camera, v.lens, b""), true))
    return _apart(chunk, scene, ideal)


def _apart(chunk: Chunk, scene: SceneGraph, views: Sequence[tuple[View, Float32]]) -> float:
    points = chunk.static.positions[chunk.static.frames >= 0]
    chosen = ratios(chunk, points) > APART
    error, count = 0.0, 0
    for view, true in views:
        index, uv, _ = visible(points, view)
        u, v = uv[chosen[index]].astype(np.int64).T
        if view.own is not None:
            u, v = u[~view.own[v, u]], v[~view.own[v, u]]
        with torch.no_grad():
            image = as_recorded(render_views(scene, [view]).color, [view]).clamp(0, 1)[0].numpy()
        error += float(np.square(image[v, u] - true[v, u]).mean(-1).sum(dtype=np.float64))
        count += len(u)
    return -10 * math.log10(error / count) if count else math.nan


def sharp_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """As :func:`beside_psnr`, where held-out frames were taken."""
    if truth is None:
        return heldout_psnr(chunk, scene)
    frames = sorted({v.frame for v in chunk.of_role("heldout")})
    return _ideal_psnr(chunk, scene, truth, novel_view_poses(chunk, (0.0,), frames))


def _ideal_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth, views: Sequence[NovelView]) -> float:
    out = []
    for view in views:
        with torch.no_grad():
            image = render_views(scene, [view]).color.clamp(0, 1)[0]
        out.append(psnr(image.numpy(), true_pixels(chunk, truth, view).astype(np.float32) / np.float32(255)))
    return float(np.mean(out))
