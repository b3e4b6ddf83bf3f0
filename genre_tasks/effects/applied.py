"""A chunk as its plan has it: what the effects that are on say of each image, and no actors where they are off.

Imports no effect: a plan's artifact holds all that is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.effects.types import EffectsPlan
from genre_tasks.scene.chunk import Actor, Chunk, Points


def applied(chunk: Chunk, plan: EffectsPlan) -> Chunk:
    """The chunk itself where no effect has anything to say of it."""
    if chunk.actors and not plan.on("rigid_actors"):
        chunk = replace(chunk, static=_standing(chunk), actors=())
    gains, own = plan.fitted.gains, plan.fitted.own
    if not gains and not own:
        return chunk
    views = [replace(v, log_gain=gains.get((v.camera, v.frame)), own=own.get(v.camera)) for v in chunk.views]
    return replace(chunk, views=tuple(views))


def _standing(chunk: Chunk) -> Points:
    """The background with every actor's points where its own sweep saw them."""
    parts = [chunk.static, *(_in_chunk(actor) for actor in chunk.actors)]
    names = ("positions", "colors", "colored", "frames")
    return Points(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _in_chunk(actor: Actor) -> Points:
    at = {int(frame): pose.astype(np.float32) for frame, pose in zip(actor.frames, actor.chunk_SE3_box, strict=True)}
    known = np.isin(actor.points.frames, actor.frames)
    points = Points(*(getattr(actor.points, n)[known] for n in ("positions", "colors", "colored", "frames")))
    poses = np.stack([at[int(f)] for f in points.frames]) if len(points) else np.zeros((0, 4, 4), np.float32)
    moved = np.einsum("pij,pj->pi", poses[:, :3, :3], points.positions) + poses[:, :3, 3]
    return replace(points, positions=moved.astype(np.float32))
