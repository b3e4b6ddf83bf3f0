"""What removed actors hid: which of a view's pixels show background that no recorded image shows."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.fixer.view_surface import Surface, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.rollout.moment_actors import THIS_MOMENT, pose_actors
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import View
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph

COVERED_ALPHA = 0.1
"""An actor covers a pixel where it takes at least this part of its light."""


@dataclass(frozen=True)
class RemovedActors:
    """Actors that an edit took away or moved, and what recorded images show apart from them.

    Attributes:
        scene: their Gaussians alone, driving as recorded.
        sources: recorded images; what lies behind the actors is hidden from them.
        recorded: all actors of the chunk, as the images show them.
    """

    scene: SceneGraph
    sources: tuple[SourceImage, ...]
    recorded: tuple[ActorNode, ...]


def select_actors(scene: SceneGraph, track_ids: Collection[str]) -> SceneGraph:
    """Takes the Gaussians of some actors out of a scene.

    Args:
        scene: of a chunk.
        track_ids: of the actors.

    Returns:
        A scene of these actors alone.
    """
    chosen = [FIRST_ACTOR + k for k, actor in enumerate(scene.actors) if actor.track_id in track_ids]
    rows = torch.isin(scene.nodes, torch.tensor(chosen, dtype=scene.nodes.dtype))
    harmonics = scene.spherical_harmonics
    # Actors keep their indices, so that nodes and deformations stay valid.
    return replace(
        scene,
        gaussians=map_attributes(lambda values: values[rows], scene.gaussians),
        nodes=scene.nodes[rows],
        spherical_harmonics=None if harmonics is None else harmonics[rows],
    )


def separate_removed_actors(
    scene: SceneGraph,
    removed: Sequence[ActorNode],
    sources: Sequence[SourceImage],
    views: Sequence[View],
    settings: RenderSettings,
) -> RemovedActors:
    """Finds what recorded images show apart from removed actors.

    LiDAR alone leaves gaps between its rings, through which an actor's pixels would pass for the background's. So the
    actors' Gaussians are rendered into the depth of the images.

    Args:
        scene: as recorded.
        removed: actors that an edit took away or moved, as recorded.
        sources: recorded images.
        views: those of the images, in the same order, without motion blur.
        settings: of the renderer.

    Returns:
        The images without what the actors hide.
    """
    actors = select_actors(scene, {actor.track_id for actor in removed})
    hidden = []
    for source, view in zip(sources, views, strict=True):
        drawn = render_views(actors, [view], settings)
        covered = drawn.alpha[0] >= COVERED_ALPHA
        hidden.append(_hide_behind(source, torch.where(covered, drawn.expected_depth()[0], torch.inf)))
    return RemovedActors(actors, tuple(hidden), scene.actors)


def find_uncovered_area(
    images: RolloutImages, depth: Tensor, removed: RemovedActors, settings: RenderSettings
) -> Tensor:
    """Finds the pixels that removed actors covered and whose background no recorded image shows.

    Args:
        images: of one pose.
        depth: [C, H, W] metres to the background, 0 where unknown. LiDAR knows a road that no image shows, and the
            render does not: it looks through thin Gaussians there.
        removed: actors that were there.
        settings: of the renderer.

    Returns:
        [C, H, W] true there; what the actors did not cover is not in it.
    """
    first, last = images.chunk_scene.chunk.frames[0], images.chunk_scene.chunk.frames[-1]
    # At moments of other chunks what this one's images lack is still where an actor was at the nearest of their frames.
    views = [replace(view, frame=min(max(view.frame, first), last)) for view in images.views]
    drawn = render_views(removed.scene, views, settings)
    # What is nearer than the actor was never hidden by it.
    covered = (drawn.alpha >= COVERED_ALPHA) & ((depth == 0) | (depth > drawn.expected_depth()))
    uncovered = torch.zeros_like(covered)
    by_track = {actor.track_id: actor for actor in removed.recorded}
    frames = sorted({source.frame for source in removed.sources})
    for k, view in enumerate(images.views):
        asked = covered[k]
        if not bool(asked.any()):
            continue
        posed = pose_actors(images.chunk_scene.scene.actors, {THIS_MOMENT: view.frame}, by_track, frames)
        known = (depth[k] > 0).to(depth)
        surface = unproject_surface(depth[k], known, view.chunk_SE3_camera, view.lens, posed, THIS_MOMENT)
        # Few pixels are asked about, so that all images can answer.
        points = Surface(*(t[asked][None] for t in (surface.points, surface.known, surface.actor)))
        visible = torch.zeros_like(points.known)
        for source in removed.sources:
            visible |= sample_source(points, source, posed, THIS_MOMENT)[1]
        uncovered[k, asked] = ~visible[0]
    return uncovered


def _hide_behind(source: SourceImage, obstacle: Tensor) -> SourceImage:
    """The image with what is behind an obstacle [H, W] metres hidden; infinite: there is none."""
    nearest = torch.where(source.depth > 0, torch.minimum(source.depth, obstacle), obstacle)
    return replace(source, depth=torch.where(torch.isfinite(obstacle), nearest, source.depth))
