"""The stage ``fnet``: novel views are repaired by the one-step diffusion fixer (paper Sec. III-B)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from threading import Lock

import torch

from genre_tasks.checks import check_finite
from genre_tasks.config import FnetConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.fixer.inference import draw_noise, encode_reference, find_reduction, fix, prefers_bfloat16
from genre_tasks.fixer.inputs import build_inputs
from genre_tasks.fixer.network import Encoded, Fnet
from genre_tasks.fixer.source_images import find_references, load_source_images
from genre_tasks.fixer.view_surface import unproject_surface
from genre_tasks.fixer.warping import SourceImage, unseen_fraction
from genre_tasks.fixer.weight_files import find_fixer_weights, require_timestep
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.image_memory import allocate_images
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews, NovelViews
from genre_tasks.threads import map_single_threaded


def fnet(
    config: FnetConfig,
    chunk: Chunk,
    novel: NovelViews,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
) -> FixedViews:
    """Repairs each novel view from its render, its LiDAR map and source images.

    The result depends on ``config.seed`` and a view's index in ``novel``. It does not depend on the number of threads;
    another batch size changes it within float tolerance. A view that needs no repair (``config.gate``) is its render.

    Args:
        config: which network, and how it runs.
        chunk: as ``ingest`` made it.
        novel: renders and LiDAR maps of this chunk.
        plan: of the chunk's effects.
        progress: called with the views done and their total.

    Returns:
        Images in [0, 1], in the order of ``novel``.

    Raises:
        InputError: the weights are missing or do not fit, or a reference is no view of the chunk.
        NonFiniteError: a render is not finite.
    """
    return fix_views(load_configured_fnet(config), config, apply_plan(chunk, plan), novel, progress)


def load_configured_fnet(config: FnetConfig) -> Fnet:
    """Loads the network that the configuration names.

    Args:
        config: with model, weights and timestep.

    Returns:
        The network, ready for inference.

    Raises:
        InputError: the weights are missing, do not fit, or were trained at another timestep.
    """
    network = load_fnet(find_fixer_weights(config), config.model)
    require_timestep(network.architecture.timestep, config.timestep)
    return network


def fix_views(
    network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, progress: Progress = silent
) -> FixedViews:
    """Repairs novel views with a network at hand.

    Args:
        network: the fixer.
        config: seed, gate, precision and batch size.
        chunk: with its plan's effects applied.
        novel: renders and LiDAR maps of this chunk.
        progress: called with the views done and their total.

    Returns:
        As :func:`fnet`.

    Raises:
        InputError: a reference is no view of the chunk.
        NonFiniteError: a render is not finite.
    """
    total = len(novel.views)
    if not total:
        return FixedViews(novel.views, novel.color.clone())
    # Checked for all views, those that are only copied too.
    check_finite(novel.color.float(), "render", "fnet")
    sources = load_source_images(chunk)
    references = find_references(chunk, novel.views, sources)
    # A gate of 0 fixes every view, without the time that estimating the need takes.
    selected = [i for i in range(total) if config.gate == 0 or estimate_need(chunk, novel, i, sources) > config.gate]
    # Views that are not selected are their renders, clamped as the fixer's output is.
    color = torch.clamp(novel.color, 0, 1, out=allocate_images(*novel.color.shape, device=novel.color.device))
    if not selected:
        return FixedViews(novel.views, color, tuple(range(total)))
    # Both sides of a frame and all shifts share their reference.
    height, width = novel.alpha.shape[1:]
    reduction = find_reduction(config.max_network_px, height, width)
    encoded = _encode_references(network, [references[i] for i in selected], reduction)
    half = prefers_bfloat16(novel.color.device) if config.half is None else config.half
    done = 0
    lock = Lock()

    def fix_batch(indices: Sequence[int]) -> None:
        nonlocal done
        views = build_inputs(chunk, novel, indices, sources)
        # Noise depends on a view's index, so that batches and threads do not matter.
        noise = draw_noise(network, config.seed, indices, height, width, reduction)
        latent = torch.cat([encoded[novel.views[i].reference].latent for i in indices])
        fixed = fix(network, views, noise, Encoded(latent, ()), half, reduction=reduction)
        # Filled in place: joining the batches at the end would need the memory twice.
        color[list(indices)] = fixed.permute(0, 2, 3, 1)
        # Batches end in any order, on several threads.
        with lock:
            done += len(indices)
            progress(done, len(selected), "fixing views")

    size = config.batch_views
    start_s = time.perf_counter()
    batches = [selected[first : first + size] for first in range(0, len(selected), size)]
    map_single_threaded(fix_batch, batches)
    # Reported with the time that copying saved, so that a gate can be judged.
    copied = tuple(sorted(set(range(total)) - set(selected)))
    seconds_per_view = (time.perf_counter() - start_s) / len(selected)
    return FixedViews(novel.views, color, copied, len(copied) * seconds_per_view)


def estimate_need(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> float:
    """Estimates how much of a view calls for repair: what is thin, or shows points that no source image shows.

    Args:
        chunk: that the view is of.
        novel: renders and LiDAR maps.
        index: of the view.
        sources: the chunk's source images.

    Returns:
        Fraction of the view's light, in [0, 1].
    """
    view = novel.views[index]
    alpha = novel.alpha[index]
    surface = unproject_surface(novel.depth[index], alpha, view.chunk_SE3_camera, view.lens, chunk.actors, view.frame)
    return unseen_fraction(surface, alpha, sources, chunk.actors, view.frame)


def _encode_references(network: Fnet, images: Sequence[SourceImage], reduction: int) -> dict[tuple[str, int], Encoded]:
    """Latents of source images by camera and frame, each encoded once."""
    image_of_source = {(s.camera, s.frame): s.image for s in images}
    encoded = map_single_threaded(
        partial(encode_reference, network, reduction=reduction), list(image_of_source.values())
    )
    return dict(zip(image_of_source, encoded, strict=True))
