"""Images beside the path that the optimiser sees in training: FNet's, or what stands in for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import torch

from flows.pipeline.definition import weights_digest
from flows.training.scene_starts import Begin, Weights, begin_key
from flows.training.training_scenes import PreparedScene, SceneRecipe, kept
from genre_tasks.config import FnetConfig, NovelViewsConfig
from genre_tasks.errors import ConfigError
from genre_tasks.fixer.network import Fnet
from genre_tasks.losses.ssim import blur
from genre_tasks.render import render_views
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.scene.novel_views import FixedViews, NovelViews
from genre_tasks.stages.fnet import fix_views, load_configured
from genre_tasks.stages.novel_views import novel_views
from genre_tasks.weights import resolve_weights
from storage.address import Address
from storage.keys import digest_value
from storage.local import LocalStore

STAND_IN_TRUTH = 0.6
NOVEL = NovelViewsConfig()


@dataclass(frozen=True)
class Images:
    """Who makes them, and of which scene's renders: that where the optimisation begins, or another of the chunk."""

    by: Literal["fnet", "stand_in"]
    of: Begin | None = None


def images_key(recipe: SceneRecipe, begin: Begin, weights: Weights, fnet_weights: str) -> str:
    """The key of FNet's images: of the scene that is rendered, of how, and of the fixer's bytes."""
    fixer = weights_digest(resolve_weights("fnet", fnet_weights))
    return digest_value([begin_key(recipe, begin, weights), NOVEL.model_dump(mode="json"), fixer])


def fixed_views(
    store: LocalStore, scene: PreparedScene, begin: Begin, start: Reconstruction, weights: Weights, fnet_weights: str
) -> FixedViews:
    """FNet's images at ±3 m of ``start``, the scene at ``begin``, from the store, or made and stored."""
    key = images_key(scene.recipe, begin, weights, fnet_weights)
    address = Address(scene.chunk.dataset, scene.chunk.log, scene.chunk.index, "fnet", key)
    value: FixedViews = kept(store, address, "fixed_views", lambda: fix(scene, start, fnet_weights))
    return value


def fix(scene: PreparedScene, start: Reconstruction, fnet_weights: str = "builtin") -> FixedViews:
    """FNet's images of the scene at ±3 m; on a street, of the views whose true image is not kept to judge.

    Where every view's true image is kept, all are fixed.
    """
    rendered = novel_views(NOVEL, scene.chunk, start)
    judged = set() if scene.truth is None else {(v.camera, v.frame, v.shift_m) for v in scene.truth.views}
    rest = [i for i, v in enumerate(rendered.views) if (v.camera, v.frame, v.shift_m) not in judged]
    config = FnetConfig(weights=fnet_weights)
    network = _loaded(config, str(weights_digest(resolve_weights("fnet", fnet_weights))))
    return fix_views(network, config, scene.chunk, _some(rendered, rest) if rest else rendered)


def stand_in_views(scene: PreparedScene, start: Reconstruction) -> FixedViews:
    """What stands in for FNet's images before FNet is trained: true images, blurred and mixed with the render.

    Every other view of a street's truth is taken. Raises ``ConfigError`` for a log without true images.
    """
    if scene.truth is None:
        raise ConfigError(
            "There are no true images to stand in for FNet's",
            remedy="Leave real logs out of the stage (real=0), or give it FNet's images.",
            log=scene.chunk.log,
        )
    views = scene.truth.views[::2]
    with torch.no_grad():
        render = render_views(start.scene, views).color.clamp(0, 1)
    truth = torch.stack([blur(image) for image in scene.truth.color[::2]])
    return FixedViews(views, STAND_IN_TRUTH * truth + (1 - STAND_IN_TRUTH) * render)


@lru_cache(maxsize=1)
def _loaded(config: FnetConfig, digest: str) -> Fnet:
    """The fixer, loaded once for all scenes; ``digest`` is its bytes'."""
    return load_configured(config)


def _some(novel: NovelViews, which: list[int]) -> NovelViews:
    names = ("color", "alpha", "depth", "lidar_color", "lidar_alpha", "lidar_depth")
    at = torch.tensor(which)
    return replace(novel, views=tuple(novel.views[i] for i in which), **{n: getattr(novel, n)[at] for n in names})
