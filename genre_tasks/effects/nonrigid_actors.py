"""Non-rigid actors: pedestrians and cyclists change their shape as they move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.box_projection import outline
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph

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
        low, high = outline(actor, view)
        out[low[1] : high[1], low[0] : high[0]] = True
    return out


def rigid_at_first(scene: SceneGraph, chunk: Chunk) -> SceneGraph:
    """The scene with those of its actors ready to deform at the source frames; itself where there are none."""
    from genre_tasks.scene.deformation import Deformation

    own = tuple(k for k, actor in enumerate(scene.actors) if deforms(actor.label))
    frames = tuple(sorted({v.frame for v in chunk.of_role("source")}))
    return replace(scene, deformation=Deformation.none(scene.actors, own, frames)) if own else scene


EFFECT = Effect("nonrigid_actors", "area of pedestrians and cyclists", "%", 1.25, "a deformation a frame", measure)
