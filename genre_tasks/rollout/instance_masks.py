"""Which actor each pixel of a rollout shows: exact, by the Gaussians that the pixel is blended of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.render_rollout import DEFAULT_SETTINGS, RolloutImages
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.constants import ABSENT_LOGIT
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene

MIN_ALPHA = 0.5
"""A pixel that less of is covered shows nothing in particular."""

EMPTY_CLASS = 0
STATIC_CLASS = 1
DISTANT_CLASS = 2
FIRST_ACTOR_CLASS = 3

_CHANNELS = 3
_NEAR_M = 0.1
_MARGIN = 1.5


@dataclass(frozen=True)
class NodeWeights:
    """What nodes contribute to the pixels of C views.

    Attributes:
        nodes: K nodes of the scene graph: background, distant region, and the actors that may be in a view.
        weights: [K, C, H, W] in [0, 1]; they sum up to alpha, without contact shadows.
    """

    nodes: tuple[int, ...]
    weights: Tensor

    @property
    def alpha(self) -> Tensor:
        """[C, H, W] what all nodes contribute together."""
        return self.weights.sum(0)


@dataclass(frozen=True)
class Masks:
    """What the pixels of C views show.

    Attributes:
        instances: [C, H, W] int32; 0: no actor, k + 1: actor k of the scene.
        classes: [C, H, W] int32, indices into ``class_names``.
        class_names: ``empty`` (nothing, or less than half), ``static``, ``distant`` (sky and what is far), then the
            labels of the scene's actors, sorted.
        actors: the scene's actors: instance k + 1 is ``actors[k]``.
    """

    instances: Tensor
    classes: Tensor
    class_names: tuple[str, ...]
    actors: tuple[ActorNode, ...]


def render_masks(images: RolloutImages, settings: RenderSettings = DEFAULT_SETTINGS) -> Masks:
    """Renders masks of one pose of a rollout.

    A pixel shows the node that contributes most to it, if all of them together cover at least ``MIN_ALPHA`` of it.

    Args:
        images: of the pose.
        settings: backend and threads.

    Returns:
        The masks.
    """
    return assign_pixels(render_node_weights(images, settings), images.chunk_scene.scene.actors)


def assign_pixels(weights: NodeWeights, actors: tuple[ActorNode, ...]) -> Masks:
    """Gives pixels to the nodes that contribute most.

    Args:
        weights: of the nodes.
        actors: of the scene.

    Returns:
        The masks.
    """
    labels = sorted({actor.label for actor in actors})
    class_of_node = torch.tensor(
        [STATIC_CLASS, DISTANT_CLASS, *(FIRST_ACTOR_CLASS + labels.index(actor.label) for actor in actors)]
    )
    node = torch.tensor(weights.nodes)[weights.weights.argmax(0)]
    covered = weights.alpha >= MIN_ALPHA
    is_actor = covered & (node >= FIRST_ACTOR)
    nothing = torch.zeros_like(node)
    return Masks(
        instances=torch.where(is_actor, node - FIRST_ACTOR + 1, nothing).int(),
        classes=torch.where(covered, class_of_node[node], torch.full_like(node, EMPTY_CLASS)).int(),
        class_names=("empty", "static", "distant", *labels),
        actors=actors,
    )


@torch.no_grad()
def render_node_weights(images: RolloutImages, settings: RenderSettings = DEFAULT_SETTINGS) -> NodeWeights:
    """Renders how much background, distant region and actors contribute to pixels.

    The renderer blends three numbers a Gaussian, so three nodes share a render; actors outside of all views are left
    out. A view with motion blur has the weights of its pose's own time. A contact shadow counts as the ground under it.

    Args:
        images: of one pose of a rollout.
        settings: backend and threads.

    Returns:
        The weights.
    """
    scene = _hide_shadows(images.chunk_scene)
    views = [replace(view, blur=None) for view in images.views]
    visible = [k for k, actor in enumerate(scene.actors) if any(is_in_view(actor, view) for view in views)]
    nodes = (STATIC, DISTANT, *(FIRST_ACTOR + k for k in visible))
    channels: list[Tensor] = []
    for first in range(0, len(nodes), _CHANNELS):
        group = nodes[first : first + _CHANNELS]
        color = render_views(_color_nodes(scene, group), views, settings).color
        channels += [color[..., channel] for channel in range(len(group))]
    return NodeWeights(nodes, torch.stack(channels))


def is_in_view(actor: ActorNode, view: RolloutView) -> bool:
    """Tells whether an actor's box may be in an image; Gaussians a little outside of the box count too.

    Args:
        actor: with its path.
        view: camera and moment.

    Returns:
        False only where it certainly is not.
    """
    box = actor.pose(view.frame)
    if box is None:
        return False
    corners = _MARGIN * _box_corners(actor.size_m)
    camera_SE3_box = np.linalg.inv(view.chunk_SE3_camera) @ box
    points = corners @ camera_SE3_box[:3, :3].T + camera_SE3_box[:3, 3]
    ahead = points[:, 2] > _NEAR_M
    # A box that reaches behind the camera covers no rectangle: it counts as visible.
    if not ahead.all():
        return bool(ahead.any())
    lens = view.lens
    u = points[:, 0] / points[:, 2] * lens.fx_px + lens.cx_px
    v = points[:, 1] / points[:, 2] * lens.fy_px + lens.cy_px
    # Lens distortion and a rolling shutter move pixels by less than half an image.
    inside_u = u.max() > -0.5 * lens.width_px and u.min() < 1.5 * lens.width_px
    inside_v = v.max() > -0.5 * lens.height_px and v.min() < 1.5 * lens.height_px
    return bool(inside_u and inside_v)


def _box_corners(size_m: tuple[float, float, float]) -> Float64:
    signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return np.asarray(signs * np.array(size_m))


def _hide_shadows(chunk_scene: ChunkScene) -> SceneGraph:
    # A shadow belongs to its actor's node, and would make thin ground a part of the actor.
    is_shadow = chunk_scene.find_shadows()
    gaussians = chunk_scene.scene.gaussians
    opacities = gaussians.logit_opacities.masked_fill(is_shadow, ABSENT_LOGIT)
    return chunk_scene.scene.with_gaussians(replace(gaussians, logit_opacities=opacities))


def _color_nodes(scene: SceneGraph, group: Sequence[int]) -> SceneGraph:
    """The scene with one channel for each node of a group: 1 for its Gaussians, 0 for all others."""
    colors = torch.zeros_like(scene.gaussians.colors)
    for channel, node in enumerate(group):
        colors[scene.nodes == node, channel] = 1.0
    gaussians: Gaussians = replace(scene.gaussians, colors=colors)
    return scene.with_gaussians(gaussians).with_spherical_harmonics(None)
