"""Non-rigid actors: pedestrians and cyclists change their shape as they move."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.projection import NEAR_M

WORDS = ("pedestrian", "person", "cycl", "rider", "scooter")
"""A label with one of these in it."""


def measure(seen: Seen) -> Measured:
    """The share of the source images' area that boxes of pedestrians and cyclists cover."""
    own = [a for a in seen.chunk.actors if any(word in a.label.lower() for word in WORDS)]
    area = sum(v.lens.width_px * v.lens.height_px for v in seen.sources)
    covered = sum(_covered(actor, view) for actor in own for view in seen.sources)
    return Measured(100 * covered / area, f"{len(own)} pedestrians and cyclists that move")


def _covered(actor: Actor, view: View) -> float:
    """Pixels of the box's outline in the image, as an upright rectangle."""
    at = np.flatnonzero(actor.frames == view.frame)
    if not len(at):
        return 0.0
    corner = np.stack(np.meshgrid(*[(-s / 2, s / 2) for s in actor.size_m], indexing="ij"), -1).reshape(-1, 3)
    pose = np.linalg.inv(view.chunk_SE3_camera) @ actor.chunk_SE3_box[at[0]]
    x, y, z = (corner @ pose[:3, :3].T + pose[:3, 3]).T
    if (z < NEAR_M).any():
        return 0.0
    lens = view.lens
    u = (x / z * lens.fx_px + lens.cx_px).clip(0, lens.width_px)
    v = (y / z * lens.fy_px + lens.cy_px).clip(0, lens.height_px)
    return float(np.ptp(u) * np.ptp(v))


EFFECT = Effect("nonrigid_actors", "area of pedestrians and cyclists", "%", 0.5, "a deformation a frame", measure)
