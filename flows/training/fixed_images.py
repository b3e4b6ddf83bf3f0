"""Images at novel views that the optimiser is shown in training: FNet's, or what stands in for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import torch

from flows.pipeline.definition import digest_weights
from flows.training.scene_starts import SceneStart, StageWeights, scene_start_key
from flows.training.training_scenes import PreparedScene, SceneRecipe, get_or_make
from genre_tasks.config import FnetConfig, NovelViewsConfig
from genre_tasks.errors import ConfigError
from genre_tasks.fixer.network import Fnet
from genre_tasks.losses.ssim import blur
from genre_tasks.render import render_views
from genre_tasks.scene.novel_views import FixedViews, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.fnet import fix_views, load_configured_fnet
from genre_tasks.stages.novel_views import novel_views
from genre_tasks.weights import resolve_weights
from storage.address import Address
from storage.keys import digest_value
from storage.store import Store

STAND_IN_TRUTH = 0.6
"""Fraction of the blurred truth in a stand-in image; the rest is the render."""

# The pipeline's own settings: in training the optimiser is shown what it is shown in use.
NOVEL_VIEWS = NovelViewsConfig()


@dataclass(frozen=True)
class FixedImages:
    """Which images a training stage shows its optimiser at novel views.

    Attributes:
        maker: ``fnet``, or ``stand_in`` for what stands in for FNet before it is trained.
        rendered: whose renders are fixed; by default those of the scene where its optimisation begins.
    """

    maker: Literal["fnet", "stand_in"]
    rendered: SceneStart | None = None


def fixed_images_key(recipe: SceneRecipe, start: SceneStart, stage_weights: StageWeights, fnet_weights: str) -> str:
    """Computes the key of FNet's images of a scene.

    Args:
        recipe: the scene.
        start: which state of it is rendered.
        stage_weights: finds the weights that take part in the start.
        fnet_weights: FNet's weights: a path, or ``builtin``. Their bytes count.

    Returns:
        64 hex digits.
    """
    # By its bytes: another fixer at the same path gives other images.
    fixer = digest_weights(resolve_weights("fnet", fnet_weights))
    return digest_value([scene_start_key(recipe, start, stage_weights), NOVEL_VIEWS.model_dump(mode="json"), fixer])


def get_fixed_views(
    store: Store,
    scene: PreparedScene,
    start: SceneStart,
    started: Reconstruction,
    stage_weights: StageWeights,
    fnet_weights: str,
) -> FixedViews:
    """Reads FNet's images of a scene at ± 3 m from the store, or makes and stores them.

    Args:
        store: the training's store.
        scene: the training scene.
        start: which state of it is rendered.
        started: the scene in that state.
        stage_weights: finds the weights that take part in the start.
        fnet_weights: FNet's weights: a path, or ``builtin``.

    Returns:
        The images [V, H, W, 3] in [0, 1].
    """
    key = fixed_images_key(scene.recipe, start, stage_weights, fnet_weights)
    address = Address(scene.chunk.dataset, scene.chunk.log, scene.chunk.index, "fnet", key)
    value: FixedViews = get_or_make(store, address, "fixed_views", lambda: fix_scene(scene, started, fnet_weights))
    return value


def fix_scene(scene: PreparedScene, started: Reconstruction, fnet_weights: str = "builtin") -> FixedViews:
    """Renders a scene at ± 3 m and fixes the renders with FNet.

    Args:
        scene: the training scene.
        started: the scene in the state that is rendered.
        fnet_weights: FNet's weights: a path, or ``builtin``.

    Returns:
        The fixed images. Views whose true image is kept for evaluation are left out, unless all of them are.
    """
    rendered = novel_views(NOVEL_VIEWS, scene.chunk, started)
    # A view must not be shown to the optimiser and score it too.
    evaluated = set() if scene.truth is None else {(v.camera, v.frame, v.shift_m) for v in scene.truth.views}
    rest = [i for i, v in enumerate(rendered.views) if (v.camera, v.frame, v.shift_m) not in evaluated]
    config = FnetConfig(weights=fnet_weights)
    network = _load_fixer(config, str(digest_weights(resolve_weights("fnet", fnet_weights))))
    return fix_views(network, config, scene.chunk, _select_views(rendered, rest) if rest else rendered)


def make_stand_in_views(scene: PreparedScene, started: Reconstruction) -> FixedViews:
    """Makes what stands in for FNet's images before FNet is trained: true images, blurred and mixed with the render.

    Args:
        scene: the training scene.
        started: the scene in the state that is rendered.

    Returns:
        Images at every other view of the scene's truth.

    Raises:
        ConfigError: the log has no true images.
    """
    if scene.truth is None:
        raise ConfigError(
            "There are no true images to stand in for FNet's",
            remedy="Leave real logs out of the stage (real=0), or give it FNet's images.",
            log=scene.chunk.log,
        )
    # Every other view only: the rest stays unseen, to score the optimiser by.
    views = scene.truth.views[::2]
    with torch.no_grad():
        # Clamped, because an image file cannot hold what lies outside [0, 1] either.
        render = render_views(started.scene, views).color.clamp(0, 1)
    # FNet's images are a little soft and keep some of the render's errors.
    truth = torch.stack([blur(image) for image in scene.truth.color[::2]])
    return FixedViews(views, STAND_IN_TRUTH * truth + (1 - STAND_IN_TRUTH) * render)


# The digest is part of the arguments, so that other weights at the same path are loaded again.
@lru_cache(maxsize=1)
def _load_fixer(config: FnetConfig, digest: str) -> Fnet:
    return load_configured_fnet(config)


def _select_views(views: NovelViews, indices: list[int]) -> NovelViews:
    names = ("color", "alpha", "depth", "lidar_color", "lidar_alpha", "lidar_depth")
    rows = torch.tensor(indices)
    tensors = {name: getattr(views, name)[rows] for name in names}
    return replace(views, views=tuple(views.views[i] for i in indices), **tensors)
