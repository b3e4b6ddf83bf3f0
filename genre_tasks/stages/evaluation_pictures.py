"""Pictures of the evaluation for the report: the same viewpoints for every stage, with the truth where it is known."""

from __future__ import annotations

from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.config import EvaluateConfig
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.scoring import decode_view_image, truth_image
from genre_tasks.metrics.view_scores import show_truth_on_ego
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews, NovelView
from genre_tasks.stages.evaluation_renders import render_batches

PICTURE_SHIFT_M = 3.0
"""Pictures at a shift are taken where the fixer works, at ±3 m."""


def render_pictures(
    config: EvaluateConfig, chunk: Chunk, scene: SceneGraph, truth: Truth | None, settings: RenderSettings
) -> dict[str, NDArray[np.uint8]]:
    """Renders a scene at the report's viewpoints.

    A render of a recorded view has the true pixels where the image shows the recording vehicle. No scene has them, and
    maps of errors would count them.

    Args:
        config: how many pictures.
        chunk: that the scene is of.
        scene: to render.
        truth: of the log, where it can be ray-cast.
        settings: of the renderer.

    Returns:
        Images [H, W, 3] by name; ``NAME.truth`` is what picture ``NAME`` should show.
    """
    pictures = {}
    for view in _choose_viewpoints(config, chunk):
        # One by one: the report needs a handful, at viewpoints of several cameras.
        name = _name_picture(view)
        ((_, images),) = render_batches(scene, [view], settings, None)
        if isinstance(view, View):
            recorded = decode_view_image(view)
            # As in metrics: the recording vehicle is neither an error of the scene nor its merit.
            images = show_truth_on_ego([view], images, recorded[None])
            pictures[f"{name}.truth"] = _to_uint8(recorded)
        pictures[name] = _to_uint8(images[0])
        if isinstance(view, NovelView) and truth is not None:
            pictures[f"{name}.truth"] = truth_image(chunk, truth, view)
    return pictures


def select_fixed_pictures(
    config: EvaluateConfig, chunk: Chunk, fixed: FixedViews, truth: Truth | None
) -> dict[str, NDArray[np.uint8]]:
    """Selects the fixer's images at the report's viewpoints to the side of the path, as far as there are any.

    Args:
        config: how many pictures.
        chunk: that the views are of.
        fixed: the fixer's images.
        truth: of the log, where it can be ray-cast.

    Returns:
        Images [H, W, 3] by name, as :func:`render_pictures` names them.
    """
    index_of_view = {(v.camera, v.frame, v.shift_m): i for i, v in enumerate(fixed.views)}
    pictures = {}
    for view in _choose_viewpoints(config, chunk):
        # The fixer has no image on the path.
        if not isinstance(view, NovelView):
            continue
        index = index_of_view.get((view.camera, view.frame, view.shift_m))
        # The pipeline may fix other shifts than the report shows.
        if index is None:
            continue
        name = _name_picture(view)
        pictures[name] = _to_uint8(fixed.color[index])
        if truth is not None:
            # Of the fixed view: its pose and lens may be refined ones.
            pictures[f"{name}.truth"] = truth_image(chunk, truth, fixed.views[index])
    return pictures


def _choose_viewpoints(config: EvaluateConfig, chunk: Chunk) -> list[View | NovelView]:
    """Per camera, forward ones first, a held-out view and both sides of the source frame in the middle of the chunk."""
    frames = sorted({v.frame for v in chunk.views_with_role("source")})
    if not frames:
        return []
    # The middle of the chunk, where most was seen from both sides.
    middle = frames[len(frames) // 2]
    novel = place_novel_views(chunk, (PICTURE_SHIFT_M, -PICTURE_SHIFT_M), [middle])
    viewpoints: list[View | NovelView] = []
    # Forward cameras first: what lies ahead is what a reader looks at, and pictures are few.
    for camera in sorted(chunk.camera_names, key=lambda name: ("front" not in name, len(name))):
        heldout = [v for v in chunk.views_with_role("heldout") if v.camera == camera]
        viewpoints += sorted(heldout, key=lambda v: abs(v.frame - middle))[:1]
        viewpoints += [v for v in novel if v.camera == camera]
    return viewpoints[: config.pictures]


def _name_picture(view: View | NovelView) -> str:
    camera = _encode_camera(view.camera)
    if isinstance(view, View):
        return f"0m_{camera}_{view.frame:02d}"
    side = "left" if view.shift_m > 0 else "right"
    return f"{abs(view.shift_m):g}m_{side}_{camera}_{view.frame:02d}"


def _encode_camera(camera: str) -> str:
    """The name of a camera in the characters that the store allows in a picture's name, as in a URL but with = for %.

    >>> _encode_camera("front_camera"), _encode_camera("front camera")
    ('front_camera', 'front=20camera')
    """
    # A folder may have a name that is no text. URLs leave ~ as it is, and the store refuses it.
    return quote(camera, safe="+", errors="surrogateescape").replace("~", "%7E").replace("%", "=")


def _to_uint8(image: Tensor) -> NDArray[np.uint8]:
    # Rounded, because a cast truncates and would darken every picture.
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
