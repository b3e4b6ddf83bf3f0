"""The background that removed actors hid: Gaussians of the road that no image shows take the colours of the road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from genre_tasks.fixer.view_surface import NO_ACTOR, Surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.rollout.removed_area import RemovedActors
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.constants import ABSENT_LOGIT
from genre_tasks.scene.graph import STATIC, SceneGraph
from genre_tasks.scene.road_completion import measure_height_over_road

# A disc of the road is nearly opaque where images support it, and thin where none does.
ROAD_OPACITY = 0.95
ROAD_TOLERANCE_M = 0.35
"""Gaussians this near to the plane of the road belong to it."""

NEIGHBOURS = 400
"""Supported Gaussians of the road from which one without support takes its colour."""

# Lines, arrows and manhole covers differ more than that from asphalt.
MARKING_CONTRAST = 0.12
"""Gaussians that differ more than that from the road's median colour, in any channel, are markings."""

_BLOCK = 2000
"""Places looked up at once, which bounds the memory."""

# Tyres stand on the road, which begins here.
_CLEARANCE_M = 0.2


def repair_background(
    scene: SceneGraph, chunk: Chunk, nodes: Sequence[ActorNode], removed: RemovedActors
) -> SceneGraph:
    """Repairs the static Gaussians that removed actors hid.

    * A Gaussian of the road that no image shows takes the median colour of the nearest that some do, and is opaque.
    * One inside the space that the actors drove through is removed, because that space is empty.

    What stands behind the actors stays: its colours are better than those of its neighbours.

    Args:
        scene: as edited.
        chunk: that it is of.
        nodes: the removed actors as recorded.
        removed: recorded images without them.

    Returns:
        The scene with other static Gaussians, in the same order.
    """
    rows = torch.nonzero(scene.nodes == STATIC)[:, 0]
    means = scene.gaussians.means[rows]
    visible = _find_visible(means, removed.sources)
    positions = means.double().numpy()
    height = measure_height_over_road(np.concatenate([chunk.static.positions, positions]), chunk.chunk_SE3_ego)
    on_road = torch.from_numpy(np.abs(height[len(chunk.static) :]) < ROAD_TOLERANCE_M)
    colors = scene.gaussians.colors[rows].clone()
    unsupported = on_road & ~visible
    known = on_road & visible
    if bool(known.any()) and bool(unsupported.any()):
        asphalt = known & ((colors - colors[known].median(0).values).abs().amax(1) < MARKING_CONTRAST)
        # A road of many colours has no typical one.
        asphalt = asphalt if bool(asphalt.any()) else known
        colors[unsupported] = _take_median_of_nearest(means[asphalt], colors[asphalt], means[unsupported])
    logits = scene.gaussians.logit_opacities[rows].clone()
    opaque = torch.tensor(ROAD_OPACITY).logit().to(logits)
    logits = torch.where(unsupported, torch.maximum(logits, opaque), logits)
    logits[_find_driven_through(means, nodes)] = ABSENT_LOGIT
    harmonics = scene.spherical_harmonics
    if harmonics is not None:
        harmonics = harmonics.clone()
        # The new colour is a median over places and directions.
        harmonics[rows[unsupported]] = 0
    gaussians = replace(
        scene.gaussians,
        colors=scene.gaussians.colors.index_copy(0, rows, colors),
        logit_opacities=scene.gaussians.logit_opacities.index_copy(0, rows, logits),
    )
    return replace(scene, gaussians=gaussians, spherical_harmonics=harmonics)


def _find_visible(means: Tensor, sources: Sequence[SourceImage]) -> Tensor:
    """[N] whether any image sees a static point."""
    everywhere = torch.ones(1, len(means), dtype=torch.bool)
    surface = Surface(means[None], everywhere, torch.full((1, len(means)), NO_ACTOR))
    visible = torch.zeros(len(means), dtype=torch.bool)
    for source in sources:
        visible |= sample_source(surface, source, (), source.frame)[1][0]
    return visible


def _take_median_of_nearest(known: Tensor, colors: Tensor, places: Tensor) -> Tensor:
    """Colours [M, 3] of places [M, 3]: the median, channel by channel, of the nearest known points'."""
    tree = cKDTree(known.numpy())
    parts = []
    for block in places.split(_BLOCK):
        nearest = tree.query(block.numpy(), k=min(NEIGHBOURS, len(known)))[1].reshape(len(block), -1)
        # A median and not a mean: what is left of markings and shadows is the minority.
        parts.append(colors[torch.from_numpy(nearest)].median(1).values)
    return torch.cat(parts)


def _find_driven_through(means: Tensor, nodes: Sequence[ActorNode]) -> Tensor:
    """[N] true for points that are in the box of an actor at any frame, above the road."""
    inside = torch.zeros(len(means), dtype=torch.bool)
    for node in nodes:
        half_size = torch.tensor(node.size_m).to(means) / 2
        for pose in node.chunk_SE3_box:
            matrix = torch.as_tensor(pose).to(means)
            local = (means - matrix[:3, 3]) @ matrix[:3, :3]
            above = local[:, 2] > -half_size[2] + _CLEARANCE_M
            inside |= (local.abs() < half_size).all(1) & above
    return inside
