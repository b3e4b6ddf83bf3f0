"""Gives a chunk what its effects' plan decided, for the stages after it.

This module imports no effect: a plan's artifact holds all that is needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.types import EffectsPlan, ImageKey
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Actor, Chunk, Points, View
from genre_tasks.scene.visibility import GREY

_POINT_ATTRIBUTES = ("positions", "colors", "colored", "frames")


def apply_plan(chunk: Chunk, plan: EffectsPlan) -> Chunk:
    """Gives each view its pose, gain, ego mask, shutter and blur, and the background what effects add to it.

    That is points of multi-view stereo, and actors where they are not modelled. Points that took their colour from the
    recording vehicle lose it.

    Args:
        chunk: as ``ingest`` made it.
        plan: of this chunk.

    Returns:
        The chunk that later stages work on; ``chunk`` itself where the plan changes nothing.
    """
    ego_points = plan.parameters.ego_points
    if ego_points is not None:
        chunk = replace(chunk, static=_take_colors_away(chunk.static, ego_points))
    if chunk.actors and not plan.is_on("rigid_actors"):
        # Without nodes of their own, actors are smeared along their way, as in any static reconstruction.
        chunk = replace(chunk, static=_merge_actors_into_background(chunk), actors=())
    stereo_points = plan.parameters.stereo_points
    if stereo_points is not None:
        chunk = replace(chunk, static=_join_points([chunk.static, stereo_points]))
    # The default plan decides nothing, so that lenses stay as they are.
    undistort = bool(plan.decisions) and not plan.is_on("lens_distortion")
    views = tuple(_apply_to_view(view, plan, undistort) for view in chunk.views)
    # The same object where nothing changes: no array is copied, and callers may compare by identity.
    if all(new is old for new, old in zip(views, chunk.views, strict=True)):
        return chunk
    return replace(chunk, views=views)


def move_views(chunk: Chunk, poses: Mapping[ImageKey, Float64]) -> Chunk:
    """Gives views other poses.

    Args:
        chunk: any chunk.
        poses: [4, 4] chunk_SE3_camera by camera and frame; other views keep theirs.

    Returns:
        The chunk with moved views.
    """
    views = (replace(v, chunk_SE3_camera=poses.get((v.camera, v.frame), v.chunk_SE3_camera)) for v in chunk.views)
    return replace(chunk, views=tuple(views))


def _apply_to_view(view: View, plan: EffectsPlan, undistort: bool) -> View:
    """Returns the view itself where nothing changes; with ``undistort`` its lens is taken to be free of distortion."""
    parameters = plan.parameters
    key = (view.camera, view.frame)
    gain = parameters.gains.get(key)
    ego_mask = parameters.ego_masks.get(view.camera)
    shutter = parameters.shutters.get(key)
    blur = parameters.blurs.get(key)
    pose = parameters.poses.get(key)
    undistort = undistort and any(view.lens.distortion)
    unchanged = all(parameter is None for parameter in (gain, ego_mask, shutter, blur, pose))
    if unchanged and not undistort:
        return view
    return replace(
        view,
        chunk_SE3_camera=view.chunk_SE3_camera if pose is None else pose,
        lens=replace(view.lens, distortion=()) if undistort else view.lens,
        log_gain=gain,
        ego_mask=ego_mask,
        shutter=shutter,
        blur=blur,
    )


def _take_colors_away(points: Points, rows: NDArray[np.int64]) -> Points:
    colors = points.colors.copy()
    colors[rows] = GREY
    colored = points.colored.copy()
    colored[rows] = False
    return replace(points, colors=colors, colored=colored)


def _merge_actors_into_background(chunk: Chunk) -> Points:
    """Adds every actor's points to the background, where the point's own sweep saw them."""
    return _join_points([chunk.static, *(_points_in_chunk(actor) for actor in chunk.actors)])


def _join_points(parts: Sequence[Points]) -> Points:
    return Points(*(np.concatenate([getattr(part, name) for part in parts]) for name in _POINT_ATTRIBUTES))


def _points_in_chunk(actor: Actor) -> Points:
    """Moves an actor's points from its box into the chunk, each by the box's pose at the point's frame."""
    frames = zip(actor.frames, actor.chunk_SE3_box, strict=True)
    pose_at_frame = {int(frame): pose.astype(np.float32) for frame, pose in frames}
    # A point of a frame without an annotation has no pose that could move it.
    known = np.isin(actor.points.frames, actor.frames)
    points = Points(*(getattr(actor.points, name)[known] for name in _POINT_ATTRIBUTES))
    if len(points):
        poses = np.stack([pose_at_frame[int(frame)] for frame in points.frames])
    else:
        poses = np.zeros((0, 4, 4), np.float32)
    positions = np.einsum("pij,pj->pi", poses[:, :3, :3], points.positions) + poses[:, :3, 3]
    return replace(points, positions=positions.astype(np.float32))
