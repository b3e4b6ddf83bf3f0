"""Gaussians split where images have more than the render shows, before an optimisation.

What a scene lacks after its reconstruction is finer than its Gaussians are; where that is, the residuals say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.differentiable_render import Beside
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Frame
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import DISTANT, SceneGraph
from genre_tasks.scene.rotations import rotation_matrices

SHRINK = 2.0
"""Both halves are as long as this part of their parent's longest side; its other sides stay."""
APART = 0.65
"""The halves lie so many of the parent's longest standard deviations to both sides of its mean."""
LEFT = 0.3
"""A half is taken to leave this part of what its parent leaves unexplained; it is not looked at again."""
ROUNDS_PER_DOUBLING = 8
_BATCH_VIEWS = 6


def split_where_images_have_more(scene: SceneGraph, targets: Sequence[Target], share: float) -> SceneGraph:
    """The scene with ``share`` of its number of Gaussians more: those with the largest :func:`unexplained` are halved.

    In rounds, so that one that leaves much unexplained becomes four, eight and so on. The distant region keeps its
    number, as in per-scene density control. One half takes its parent's row, the others of a round follow at the end in
    the order of their parents' rows; both are of its node. Fewer come where too few are seen; 0: the scene itself.
    """
    more = round(share * len(scene))
    if not more or not targets:
        return scene
    of, at_once = unexplained(scene, targets), max(1, len(scene) // ROUNDS_PER_DOUBLING)
    of = torch.where(scene.nodes == DISTANT, 0.0, of)
    while (count := min(more, at_once, int((of > 0).sum()))) > 0:
        rows = torch.argsort(of, descending=True, stable=True)[:count].sort().values
        scene, more = halved(scene, rows), more - count
        of = of.index_copy(0, rows, LEFT * of[rows])
        of = torch.cat([of, of[rows]])
    return scene


def unexplained(scene: SceneGraph, targets: Sequence[Target]) -> Tensor:
    """[N]: over all pixels of the views, the squared difference of image and render by each Gaussian's share of it."""
    frame, objective = Frame.of(scene), Objective(LossConfig(perceptual=0.0, ssim=0.0, depth=0.0))
    offsets, generator = torch.zeros_like(frame.start), torch.Generator()
    beside, out = Beside(scene.deformation, scene.harmonics), offsets.new_zeros(len(scene))
    for k in range(0, len(targets), _BATCH_VIEWS):
        sight = objective(frame, offsets, targets[k : k + _BATCH_VIEWS], 0, generator, beside, residuals=True)
        assert sight.residuals is not None
        out += sight.residuals[:, 3]
    return out


def halved(scene: SceneGraph, rows: Tensor) -> SceneGraph:
    """The scene with the Gaussians ``rows`` [M] split in two along their longest side."""
    parents = map_attributes(lambda x: x[rows], scene.gaussians)
    longest = parents.log_scales.argmax(1)
    place = torch.arange(len(rows), device=longest.device)
    axis = rotation_matrices(parents.quats)[place, :, longest]
    move = axis * (APART * parents.log_scales[place, longest].exp())[:, None]
    log_scales = parents.log_scales.clone()
    log_scales[place, longest] -= math.log(SHRINK)
    first = replace(parents, means=parents.means + move, log_scales=log_scales)
    second = replace(parents, means=parents.means - move, log_scales=log_scales)
    joined = map_attributes(lambda x, a, b: torch.cat([x.index_copy(0, rows, a), b]), scene.gaussians, first, second)
    harmonics = None if scene.harmonics is None else torch.cat([scene.harmonics, scene.harmonics[rows]])
    nodes = torch.cat([scene.nodes, scene.nodes[rows]])
    return replace(scene, gaussians=joined, nodes=nodes, harmonics=harmonics)
