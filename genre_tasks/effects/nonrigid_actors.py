"""Non-rigid actors: pedestrians and cyclists change their shape as they move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.chunk import Actor, Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.projection import NEAR_M

WORDS = ("pedestrian", "person", "cycl", "rider", "scooter")
"""A label with one of these in it."""


def deforms(label: str) -> bool:
    """Whether an actor of that label is one of them."""
    return any(word in label.lower() for word in WORDS)


def measure(seen: Seen) -> Measured:
    """The share of the source images that boxes of pedestrians and cyclists cover, each as an upright rectangle."""
    shares = [0.0, *(float(covered(seen.chunk, view).mean()) for view in seen.sources)]
    count = sum(deforms(actor.label) for actor in seen.chunk.actors)
    return Measured(100 * sum(shares) / max(1, len(seen.sources)), f"{count} pedestrians and cyclists that move")


def covered(chunk: Chunk, view: View) -> NDArray[np.bool_]:
    """[H, W] where those boxes are in a view's image."""
    out = np.zeros((view.lens.height_px, view.lens.width_px), bool)
    for actor in (a for a in chunk.actors if deforms(a.label)):
        low, high = _outline(actor, view)
        out[low[1] : high[1], low[0] : high[0]] = True
    return out


def rigid_at_first(scene: SceneGraph, chunk: Chunk) -> SceneGraph:
    """The scene with those of its actors ready to deform at the source frames; itself where there are none."""
    from genre_tasks.scene.deformation import Deformation

    own = tuple(k for k, actor in enumerate(scene.actors) if deforms(actor.label))
    frames = tuple(sorted({v.frame for v in chunk.of_role("source")}))
    return replace(scene, deformation=Deformation.none(scene.actors, own, frames)) if own else scene


def _outline(actor: Actor, view: View) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last pixel (x, y) of the box in the image; what is behind the camera plane is cut off there."""
    at = np.flatnonzero(actor.frames == view.frame)
    nothing = np.zeros(2, np.int64)
    if not len(at):
        return nothing, nothing
    corner = np.stack(np.meshgrid(*[(-s / 2, s / 2) for s in actor.size_m], indexing="ij"), -1).reshape(-1, 3)
    pose = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[at[0]]
    points = corner @ pose[:3, :3].T + pose[:3, 3]
    if (points[:, 2] < NEAR_M).all():
        return nothing, nothing
    z = np.maximum(points[:, 2], NEAR_M)
    lens = view.lens
    u = (points[:, 0] / z * lens.fx_px + lens.cx_px).clip(0, lens.width_px)
    v = (points[:, 1] / z * lens.fy_px + lens.cy_px).clip(0, lens.height_px)
    return np.array([round(u.min()), round(v.min())]), np.array([round(u.max()), round(v.max())])


EFFECT = Effect("nonrigid_actors", "area of pedestrians and cyclists", "%", 1.25, "a deformation a frame", measure)
