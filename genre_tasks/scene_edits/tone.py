"""The exposure of an actor that comes from another scene, matched by the colour of the ground.

Roads are of much the same grey everywhere, and every scene has one near the path. The gain of a channel is the ratio of
the two roads' medians in linear light. It is an estimate: where one road is concrete and the other fresh asphalt, their
difference is taken for one of exposure, and so the gain is limited.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from genre_tasks.logs.types import Float64
from genre_tasks.scene.graph import STATIC
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene_edits.actor_parts import ActorPart
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.ground import Ground
from genre_tasks.srgb import linear_to_srgb, srgb_to_linear

MAX_GAIN = 2.0
"""A gain is between 1 / 2 and 2: more is a difference of roads, not of exposure."""

_NEAR_PATH_M = 6.0
_NEAR_GROUND_M = 0.15
_OPAQUE_LOGIT = 0.0
_MIN_COUNT = 50
_MAX_COUNT = 2000
_STEP = 1e-3


def measure_road_color(chunk_scene: ChunkScene, ground: Ground) -> Float64 | None:
    """Measures the colour of a scene's road.

    Args:
        chunk_scene: a chunk with its scene.
        ground: of its run.

    Returns:
        [3] the median over opaque Gaussians of the road near the path, linear light; ``None`` where there are too few.
    """
    scene = chunk_scene.scene
    gaussians = scene.gaussians
    rows = torch.nonzero((scene.nodes == STATIC) & (gaussians.logit_opacities > _OPAQUE_LOGIT))[:, 0].numpy()
    means = gaussians.means.numpy()[rows]
    # In the ground plane alone: the ego vehicle's origin is on its roof.
    level = chunk_scene.chunk.chunk_SE3_ego.copy()
    level[:, 2, 3] = 0.0
    rows = rows[distance_to_path(means * np.array([1, 1, 0], np.float32), level) < _NEAR_PATH_M]
    # Evenly thinned: a median needs no more, and the ground is fitted at every place.
    rows = rows[:: max(1, len(rows) // _MAX_COUNT)]
    if not len(rows):
        return None
    pose = chunk_scene.chunk.world_SE3_chunk
    world = gaussians.means.numpy()[rows].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    height, _ = ground.measure(world[:, :2])
    road = rows[np.abs(world[:, 2] - height) < _NEAR_GROUND_M]
    if len(road) < _MIN_COUNT:
        return None
    return np.asarray(np.median(srgb_to_linear(gaussians.colors.numpy()[road].clip(0, 1)), axis=0), np.float64)


def match_tone(source_road: Float64 | None, target_road: Float64 | None) -> Float64:
    """Computes the gain that takes colours of one scene to the exposure of another one.

    Args:
        source_road: [3] colour of the road in the actor's scene, linear light; ``None``: unknown.
        target_road: [3] colour of the road in the edited scene.

    Returns:
        [3] gains in linear light, 1 where either road is unknown.

    >>> match_tone(np.array([0.1, 0.1, 0.1]), np.array([0.15, 0.1, 0.9])).round(6).tolist()
    [1.5, 1.0, 2.0]
    """
    if source_road is None or target_road is None:
        return np.ones(3)
    # The floor keeps a black road from a division by zero.
    ratio = np.maximum(target_road, 1e-4) / np.maximum(source_road, 1e-4)
    return np.asarray(ratio.clip(1 / MAX_GAIN, MAX_GAIN), np.float64)


def apply_tone(part: ActorPart, gain: Float64) -> ActorPart:
    """Applies a gain in linear light to an actor's colours.

    Args:
        part: the actor.
        gain: [3].

    Returns:
        The actor with other colours; the same object where all gains are 1.
    """
    if (gain == 1).all():
        return part
    colors = part.gaussians.colors.numpy().astype(np.float64)
    toned = linear_to_srgb(gain * srgb_to_linear(colors))
    harmonics = part.spherical_harmonics
    if harmonics is not None:
        # To first order a harmonic grows as the colour does on which it is.
        ahead = linear_to_srgb(gain * srgb_to_linear(colors + _STEP))
        slope = torch.from_numpy((ahead - toned) / _STEP).to(harmonics)
        harmonics = harmonics * slope[:, None]
    gaussians = replace(part.gaussians, colors=torch.from_numpy(toned).to(part.gaussians.colors))
    return replace(part, gaussians=gaussians, spherical_harmonics=harmonics)
