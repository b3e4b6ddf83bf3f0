"""What removed actors hid: which of a view's pixels show background that recorded images do not show, or in shadow."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.fixer.view_surface import Surface, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.rollout.moment_actors import THIS_MOMENT, pose_actors
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import View
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.lens_distortion import pixels_to_rays
from genre_tasks.scene.transforms import invert_se3

COVERED_ALPHA = 0.1
"""An actor covers a pixel where it takes at least this part of its light."""

# The sun's direction is not known. At noon in summer a car's shadow reaches less far.
SHADOW_MARGIN_M = 1.0
"""Ground that is nearer to an actor's box than this may be in its shadow."""

# Thick enough for the ground's slope and curvature under a box.
_SHADOW_HALF_HEIGHT_M = 0.15


@dataclass(frozen=True)
class UncoveredArea:
    """Pixels that removed actors covered and that the render shows wrongly.

    Attributes:
        filled: [C, H, W] true where no recorded image shows the background, other than in an actor's shadow.
        restored: [C, H, W] true where some recorded images show the background in shadow and others do not.
    """

    filled: Tensor
    restored: Tensor

    @property
    def both(self) -> Tensor:
        """[C, H, W] filled or restored."""
        return self.filled | self.restored


@dataclass(frozen=True)
class RemovedActors:
    """Actors that an edit took away or moved, and what recorded images show apart from them.

    Attributes:
        scene: their Gaussians alone, driving as recorded.
        sources: recorded images; what lies behind the actors is hidden from them.
        unshaded: the same images; ground near the actors is hidden from them, too.
        recorded: all actors of the chunk, as the images show them.
    """

    scene: SceneGraph
    sources: tuple[SourceImage, ...]
    unshaded: tuple[SourceImage, ...]
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
        The images without what the actors hide and shade.
    """
    actors = select_actors(scene, {actor.track_id for actor in removed})
    hidden = []
    unshaded = []
    for source, view in zip(sources, views, strict=True):
        drawn = render_views(actors, [view], settings)
        covered = drawn.alpha[0] >= COVERED_ALPHA
        hidden.append(_hide_behind(source, torch.where(covered, drawn.expected_depth()[0], torch.inf)))
        shade = measure_depth_to_shadows(source.chunk_SE3_camera, source.lens, removed, source.frame)
        unshaded.append(_hide_behind(hidden[-1], shade.to(source.depth)))
    return RemovedActors(actors, tuple(hidden), tuple(unshaded), scene.actors)


def find_uncovered_area(
    images: RolloutImages, depth: Tensor, removed: RemovedActors, settings: RenderSettings
) -> UncoveredArea:
    """Finds the pixels that removed actors covered and that the render cannot show rightly.

    Args:
        images: of one pose.
        depth: [C, H, W] metres to the background, 0 where unknown. LiDAR knows a road that no image shows, and the
            render does not: it looks through thin Gaussians there.
        removed: actors that were there.
        settings: of the renderer.

    Returns:
        The pixels. What the actors did not cover is in no area.
    """
    drawn = render_views(removed.scene, images.views, settings)
    # What is nearer than the actor was never hidden by it.
    covered = (drawn.alpha >= COVERED_ALPHA) & ((depth == 0) | (depth > drawn.expected_depth()))
    filled = torch.zeros_like(covered)
    restored = torch.zeros_like(covered)
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
        lit = torch.zeros_like(points.known)
        shaded = torch.zeros_like(points.known)
        for source, unshaded in zip(removed.sources, removed.unshaded, strict=True):
            visible = sample_source(points, source, posed, THIS_MOMENT)[1]
            visible_lit = sample_source(points, unshaded, posed, THIS_MOMENT)[1]
            lit |= visible_lit
            shaded |= visible & ~visible_lit
        filled[k, asked] = ~lit[0]
        restored[k, asked] = (lit & shaded)[0]
    return UncoveredArea(filled, restored)


def measure_depth_to_shadows(
    chunk_SE3_camera: Float64, lens: Lens, actors: Sequence[ActorNode], frame: float
) -> Tensor:
    """Measures how far the ground that actors may shade is along the ray of each pixel.

    Args:
        chunk_SE3_camera: [4, 4].
        lens: of the camera.
        actors: the ground within ``SHADOW_MARGIN_M`` of their boxes counts.
        frame: log frame, or a moment between two, at which the actors are posed.

    Returns:
        [H, W] float64 metres along the camera's axis to the nearest such ground; infinite where a ray meets none.
    """
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    x, y = pixels_to_rays(u, v, lens)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    nearest = np.full(x.shape, np.inf)
    for actor in actors:
        chunk_SE3_box = actor.pose(frame)
        if chunk_SE3_box is None:
            continue
        length, width, height = actor.size_m
        half_size = np.array([length / 2 + SHADOW_MARGIN_M, width / 2 + SHADOW_MARGIN_M, _SHADOW_HALF_HEIGHT_M])
        slab_SE3_camera = invert_se3(chunk_SE3_box) @ chunk_SE3_camera
        # From the box's centre to its bottom, which is on the ground.
        slab_SE3_camera[2, 3] += height / 2
        nearest = np.minimum(nearest, _meet_box(rays @ slab_SE3_camera[:3, :3].T, slab_SE3_camera[:3, 3], half_size))
    return torch.from_numpy(nearest)


def _meet_box(directions: Float64, origin: Float64, half_size: Float64) -> Float64:
    """[H, W] how many directions [H, W, 3] it takes from the origin to a box around zero; infinite where missed."""
    # A ray that is parallel to a face would divide by zero.
    directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    to_faces = np.stack([(side * half_size - origin) / directions for side in (-1, 1)])
    entry = to_faces.min(0).max(-1)
    leave = to_faces.max(0).min(-1)
    # An origin inside of the box is behind its front face.
    return np.where((entry <= leave) & (leave > 0), np.maximum(entry, 0.0), np.inf)


def _hide_behind(source: SourceImage, obstacle: Tensor) -> SourceImage:
    """The image with what is behind an obstacle [H, W] metres hidden; infinite: there is none."""
    nearest = torch.where(source.depth > 0, torch.minimum(source.depth, obstacle), obstacle)
    return replace(source, depth=torch.where(torch.isfinite(obstacle), nearest, source.depth))
