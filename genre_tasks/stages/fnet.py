"""The stage `fnet`: novel views are repaired by the one-step diffusion fixer (paper Sec. III-B)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from threading import Lock

import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.config import FnetConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.errors import InputError
from genre_tasks.fixer.conditioning import degraded
from genre_tasks.fixer.inference import fix, noise_of, prefers_half, require_finite
from genre_tasks.fixer.network import Encoded, Fnet
from genre_tasks.fixer.source_images import recorded, references
from genre_tasks.fixer.warping import SourceImage, surface_of, unseen_share
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews, NovelViews
from genre_tasks.threads import map_single_threaded
from genre_tasks.weights import resolve_weights


def fnet(
    config: FnetConfig,
    chunk: Chunk,
    novel: NovelViews,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
) -> FixedViews:
    """Each novel view repaired from its render, its LiDAR map and its reference image.

    The result depends on ``config.seed`` and a view's place in ``novel``, not on the batch size (to float
    tolerance) nor on the number of threads (exactly). A view that does not call for it (``config.gate``) is its render.

    Raises:
        InputError: the weights are missing or do not fit, or a reference is no view of the chunk.
        NonFiniteError: a render is not finite.
    """
    return fix_views(load_configured(config), config, applied(chunk, plan), novel, progress)


def load_configured(config: FnetConfig) -> Fnet:
    """The network that the configuration names."""
    if config.model == "sd-turbo" and config.weights == "builtin":
        raise InputError(
            "no weights of sd-turbo ship with the package",
            remedy="Give by `fnet.weights` a folder that `genre train fnet` wrote, or set `fnet.model` to small.",
            stage="fnet",
        )
    network = load_fnet(resolve_weights("fnet", config.weights), config.model)
    if network.architecture.timestep != config.timestep:
        raise InputError(
            f"the weights were trained at timestep {network.architecture.timestep}, configured is {config.timestep}",
            remedy="Set `fnet.timestep` to the weights' timestep, or train others.",
            stage="fnet",
        )
    return network


def fix_views(
    network: Fnet, config: FnetConfig, chunk: Chunk, novel: NovelViews, progress: Progress = silent
) -> FixedViews:
    """As :func:`fnet`, with a network at hand."""
    total = len(novel.views)
    if not total:
        return FixedViews(novel.views, novel.color.clone())
    require_finite("render", novel.color)
    sources = recorded(chunk)
    near = references(chunk, novel.views, sources)
    called = [i for i in range(total) if config.gate == 0 or need(chunk, novel, i, sources) > config.gate]
    color = novel.color.clamp(0, 1)
    if not called:
        return FixedViews(novel.views, color, tuple(range(total)))
    encoded = _encode(network, [near[i] for i in called])
    done, lock = 0, Lock()
    half = prefers_half(novel.color.device) if config.half is None else config.half

    def run(indices: Sequence[int]) -> Tensor:
        nonlocal done
        views = degraded(chunk, novel, indices, sources)
        noise = noise_of(network, config.seed, indices, *novel.alpha.shape[1:])
        latent = torch.cat([encoded[novel.views[i].reference].latent for i in indices])
        fixed = fix(network, views, noise, Encoded(latent, ()), half)
        with lock:
            done += len(indices)
            progress(done, len(called), "fixing views")
        return fixed

    size = config.batch_views
    began = time.perf_counter()
    fixed = map_single_threaded(run, [called[start : start + size] for start in range(0, len(called), size)])
    color[called] = torch.cat(fixed).permute(0, 2, 3, 1)
    copied = tuple(sorted(set(range(total)) - set(called)))
    return FixedViews(novel.views, color, copied, len(copied) * (time.perf_counter() - began) / len(called))


def need(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> float:
    """How much a view calls for fixing, in [0, 1]: what of it is thin, or shows points that no source image shows."""
    view, alpha = novel.views[index], novel.alpha[index]
    surface = surface_of(novel.depth[index], alpha, view.chunk_SE3_camera, view.lens, chunk.actors, view.frame)
    return unseen_share(surface, alpha, sources, chunk.actors, view.frame)


@torch.no_grad()
def _encode(network: Fnet, images: Sequence[SourceImage]) -> dict[tuple[str, int], Encoded]:
    """Latents of source images, each encoded once."""

    def encode(image: Tensor) -> Encoded:
        height, width = image.shape[-2:]
        pad = (0, -width % network.stride, 0, -height % network.stride)
        with torch.no_grad():
            return Encoded(network.encode(F.pad(image[None], pad, mode="replicate")).latent, ())

    each = {(s.camera, s.frame): s.image for s in images}
    return dict(zip(each, map_single_threaded(encode, list(each.values())), strict=True))
