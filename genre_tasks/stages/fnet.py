"""The stage `fnet`: novel views are repaired by the one-step diffusion fixer (paper Sec. III-B)."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock

import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.config import FnetConfig
from genre_tasks.errors import InputError
from genre_tasks.fixer.conditioning import degraded, source_images, source_views
from genre_tasks.fixer.inference import fix, noise_of
from genre_tasks.fixer.network import Encoded, Fnet
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.metrics.threads import map_single_threaded
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.views import FixedViews, NovelViews
from genre_tasks.weights import resolve_weights


def fnet(config: FnetConfig, chunk: Chunk, novel: NovelViews, progress: Progress = silent) -> FixedViews:
    """Each novel view repaired from its render, its LiDAR map and its reference image.

    The result depends on ``config.seed`` and a view's place in ``novel``, not on the batch size (to float
    tolerance) nor on the number of threads (exactly).

    Raises:
        InputError: the weights are missing or do not fit, or a reference is no view of the chunk.
        NonFiniteError: a render is not finite.
    """
    return fix_views(load_configured(config), config, chunk, novel, progress)


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
    sources = source_views(chunk, novel.views)
    images = source_images(sources)
    encoded = _encode_references(network, images, list(images))
    done, lock = 0, Lock()

    def run(indices: range) -> Tensor:
        nonlocal done
        fixed = _fix_batch(network, config.seed, novel, indices, sources, images, encoded)
        with lock:
            done += len(indices)
            progress(done, total, "fixing views")
        return fixed

    size = config.batch_views
    batches = [range(start, min(start + size, total)) for start in range(0, total, size)]
    color = torch.cat(map_single_threaded(run, batches))
    return FixedViews(novel.views, color.permute(0, 2, 3, 1).contiguous())


def _fix_batch(
    network: Fnet,
    seed: int,
    novel: NovelViews,
    indices: range,
    sources: dict[tuple[str, int], View],
    images: dict[tuple[str, int], Tensor],
    encoded: dict[tuple[str, int], Encoded],
) -> Tensor:
    """[B, 3, H, W] of one batch."""
    views = degraded(novel, indices, sources, images)
    noise = noise_of(network, seed, indices, *novel.alpha.shape[1:])
    each = [encoded[novel.views[i].reference] for i in indices]
    latent = torch.cat([e.latent for e in each])
    return fix(network, views, noise, Encoded(latent, ()))


@torch.no_grad()
def _encode_references(
    network: Fnet, images: dict[tuple[str, int], Tensor], keys: Sequence[tuple[str, int]]
) -> dict[tuple[str, int], Encoded]:
    """Latents of the references, each encoded once."""

    def encode(key: tuple[str, int]) -> Encoded:
        image = images[key][None]
        height, width = image.shape[-2:]
        pad = (0, -width % network.stride, 0, -height % network.stride)
        with torch.no_grad():
            return Encoded(network.encode(F.pad(image, pad, mode="replicate")).latent, ())

    return dict(zip(keys, map_single_threaded(encode, keys), strict=True))
