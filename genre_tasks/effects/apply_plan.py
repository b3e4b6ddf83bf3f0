"""A chunk as its plan has it: what the effects that are on say of each image, and no actors where they are off.

Imports no effect: a plan's artifact holds all that is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.effects.types import EffectsPlan
from genre_tasks.scene.chunk import Actor, Chunk, Points, View


def applied(chunk: Chunk, plan: EffectsPlan) -> Chunk:
    """The chunk itself where no effect has anything to say of it."""
    if chunk.actors and not plan.on("rigid_actors"):
        chunk = replace(chunk, static=_standing(chunk), actors=())
    straight = bool(plan.decisions) and not plan.on("lens_distortion")
    views = tuple(_as_planned(v, plan, straight) for v in chunk.views)
    return chunk if all(a is b for a, b in zip(views, chunk.views, strict=True)) else replace(chunk, views=views)


def _as_planned(view: View, plan: EffectsPlan, straight: bool) -> View:
    """The view itself where nothing is said of it; ``straight``: with its lens taken to be free of distortion."""
    fitted, key = plan.fitted, (view.camera, view.frame)
    gain, own = fitted.gains.get(key), fitted.own.get(view.camera)
    shutter, blur = fitted.shutters.get(key), fitted.blurs.get(key)
    straight = straight and any(view.lens.distortion)
    if all(said is None for said in (gain, own, shutter, blur)) and not straight:
        return view
    lens = replace(view.lens, distortion=()) if straight else view.lens
    return replace(view, lens=lens, log_gain=gain, own=own, shutter=shutter, blur=blur)


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
