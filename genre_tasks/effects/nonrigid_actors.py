"""Non-rigid actors: pedestrians and cyclists change their shape as they move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.seen import Seen
from genre_tasks.effects.types import Effect, Measured
from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.projection import NEAR_M

WORDS = ("pedestrian", "person", "cycl", "rider", "scooter")
"""A label with one of these in it."""


def measure(seen: Seen) -> Measured:
    """The share of the source images that boxes of pedestrians and cyclists cover, each as an upright rectangle."""
    own = [a for a in seen.chunk.actors if any(word in a.label.lower() for word in WORDS)]
    shares = [0.0]
    for view in seen.sources:
        covered = np.zeros((view.lens.height_px, view.lens.width_px), bool)
        for actor in own:
            low, high = _outline(actor, view)
            covered[low[1] : high[1], low[0] : high[0]] = True
        shares.append(float(covered.mean()))
    return Measured(100 * sum(shares) / max(1, len(seen.sources)), f"{len(own)} pedestrians and cyclists that move")


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


EFFECT = Effect(
    "nonrigid_actors", "area of pedestrians and cyclists", "%", 0.5, "a deformation a frame", measure, marks=True
)
