"""Non-rigid actors: pedestrians and cyclists change their shape as they move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph

# Parts of words, because every data set has labels of its own: ``Pedestrian with Object``, ``Motorized Scooter``.
DEFORMABLE_WORDS = ("pedestrian", "person", "cycl", "rider", "scooter")
"""An actor whose label contains one of these changes its shape."""


def is_deformable(label: str) -> bool:
    """Tells whether actors of a label change their shape as they move.

    Args:
        label: of an annotated track, in any case.

    Returns:
        Whether the label contains one of ``DEFORMABLE_WORDS``.

    >>> is_deformable("Motorcyclist"), is_deformable("Car")
    (True, False)
    """
    # Lower case, because data sets differ in how they capitalise labels.
    return any(word in label.lower() for word in DEFORMABLE_WORDS)


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures the area of the source images that boxes of pedestrians and cyclists cover.

    Args:
        measurements: the chunk's actors and source views.

    Returns:
        Percentage of the image area, mean over the source images; a box counts as an upright rectangle.
    """
    chunk = measurements.chunk
    views = measurements.source_views
    fractions = [0.0, *(float(mask_deformable_actors(chunk, view).mean()) for view in views)]
    count = sum(is_deformable(actor.label) for actor in chunk.actors)
    return Measurement(100 * sum(fractions) / max(1, len(views)), f"{count} pedestrians and cyclists that move")


def mask_deformable_actors(chunk: Chunk, view: View) -> NDArray[np.bool_]:
    """Finds where boxes of pedestrians and cyclists are in an image.

    Args:
        chunk: with its actors.
        view: of the chunk.

    Returns:
        [H, W] true inside the upright rectangles around the boxes.
    """
    mask = np.zeros((view.lens.height_px, view.lens.width_px), bool)
    for actor in (a for a in chunk.actors if is_deformable(a.label)):
        low, high = project_box(actor, view)
        # A mask and not a sum of areas: people who overlap count once.
        mask[low[1] : high[1], low[0] : high[0]] = True
    return mask


def add_rest_deformation(scene: SceneGraph, chunk: Chunk) -> SceneGraph:
    """Prepares the actors that change their shape for deforming, at the chunk's source frames.

    Args:
        scene: the initial scene.
        chunk: that the scene is of.

    Returns:
        The scene with a deformation that moves nothing yet; ``scene`` itself where no actor changes its shape.
    """
    # Imported where it is needed: a scene without deformation does without its code.
    from genre_tasks.scene.deformation import Deformation

    deformable = tuple(k for k, actor in enumerate(scene.actors) if is_deformable(actor.label))
    if not deformable:
        return scene
    frames = tuple(sorted({view.frame for view in chunk.views_with_role("source")}))
    return replace(scene, deformation=Deformation.zero(scene.actors, deformable, frames))


EFFECT = Effect(
    name="nonrigid_actors",
    property="area of pedestrians and cyclists",
    unit="%",
    threshold=1.25,
    cost="a deformation a frame",
    measure=measure,
    # Without nodes of their own, actors are points of the background, which has no boxes that could deform.
    requires="rigid_actors",
)
