"""Splits Gaussians where images show more than the render does, before an optimisation.

What a scene lacks after its reconstruction is finer than its Gaussians are. The residuals tell where that is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.gradients import WEIGHTED_SQUARED_RESIDUAL
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import DISTANT, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices

SHRINK = 2.0
"""Each half's longest side is its parent's divided by this; the other sides stay."""

SEPARATION = 0.65
"""The halves lie this many of the parent's longest standard deviations to either side of its mean."""

REMAINING_ENERGY = 0.3
"""A half is assumed to keep this fraction of its parent's residual energy; it is not measured again."""

ROUNDS_PER_DOUBLING = 8
_BATCH_VIEWS = 6
# Of the square of a side that points at the viewer, so that its logarithm is finite.
_LEAST_ACROSS = 1e-6


def split_by_residual(scene: SceneGraph, targets: Sequence[Target], fraction: float) -> SceneGraph:
    """Splits the Gaussians with the largest residual energy.

    It goes in rounds, so that a Gaussian that explains little becomes four, eight and so on. The distant shell takes
    part: clouds are finer than its even spacing, and lie the same in every view beside the path.

    Args:
        scene: of N Gaussians.
        targets: images to compare the scene with.
        fraction: how many Gaussians to add, as a fraction of N; 0 returns the scene itself.

    Returns:
        SceneGraph: up to N + ``fraction`` · N Gaussians, fewer where fewer are visible. One half takes its parent's
        row; the others of a round follow at the end, in the order of their parents' rows.
    """
    remaining = round(fraction * len(scene))
    if not remaining or not targets:
        return scene
    energy = residual_energy(scene, targets)
    round_limit = max(1, len(scene) // ROUNDS_PER_DOUBLING)
    while True:
        # An energy of 0 is never split.
        count = min(remaining, round_limit, int((energy > 0).sum()))
        if count <= 0:
            return scene
        # Ranked by energy, then put in order of rows, in which the new halves are appended.
        rows = torch.argsort(energy, descending=True, stable=True)[:count].sort().values
        scene = split_along_longest_axis(scene, rows)
        remaining -= count
        # An estimate instead of another render: only the order of the next rounds depends on it.
        energy = energy.index_copy(0, rows, REMAINING_ENERGY * energy[rows])
        energy = torch.cat([energy, energy[rows]])


def residual_energy(scene: SceneGraph, targets: Sequence[Target]) -> Tensor:
    """Measures how much of the images each Gaussian fails to explain.

    Args:
        scene: of N Gaussians.
        targets: images to compare the scene with.

    Returns:
        [N] squared difference of image and render, weighted by the Gaussian's blending weight and summed over all
        pixels of all views.
    """
    parameterization = Parameterization.from_scene(scene)
    # Residuals do not depend on the loss; the colour term alone is the cheapest one to differentiate.
    objective = Objective(LossConfig(perceptual=0.0, ssim=0.0, depth=0.0))
    offsets = torch.zeros_like(parameterization.initial)
    auxiliary = AuxiliaryParameters.from_scene(scene)
    generator = torch.Generator()
    energy = offsets.new_zeros(len(scene))
    # A few views at a time, since the renders of all of them would not fit the memory of a small machine.
    for begin in range(0, len(targets), _BATCH_VIEWS):
        batch = targets[begin : begin + _BATCH_VIEWS]
        evaluation = objective.evaluate(
            parameterization, offsets, batch, 0, generator, auxiliary=auxiliary, image_residuals=True
        )
        assert evaluation.gradients.image_residuals is not None
        energy += evaluation.gradients.image_residuals[:, WEIGHTED_SQUARED_RESIDUAL][:, 0]
    return energy


def split_along_longest_axis(scene: SceneGraph, rows: Tensor) -> SceneGraph:
    """Splits some Gaussians in two along their longest side; distant ones along that which looks longest.

    Args:
        scene: of N Gaussians.
        rows: [M] which to split.

    Returns:
        SceneGraph: of N + M Gaussians. One half takes its parent's row, the other is appended; both keep its node,
        colour, opacity and spherical harmonics.
    """
    parents = map_attributes(lambda x: x[rows], scene.gaussians)
    axes = quats_to_matrices(parents.quats)
    is_distant = (scene.nodes[rows] == DISTANT)[:, None]
    visible = torch.where(is_distant, _visible_log_scales(parents, axes), parents.log_scales)
    longest = visible.argmax(1)
    index = torch.arange(len(rows), device=longest.device)
    axis = axes[index, :, longest]
    shift = axis * (SEPARATION * parents.log_scales[index, longest].exp())[:, None]
    log_scales = parents.log_scales.clone()
    # Opacity stays: the halves overlap in the middle, and each covers half of what the parent did.
    log_scales[index, longest] -= math.log(SHRINK)
    first = replace(parents, means=parents.means + shift, log_scales=log_scales)
    second = replace(parents, means=parents.means - shift, log_scales=log_scales)

    def join(values: Tensor, first_half: Tensor, second_half: Tensor) -> Tensor:
        return torch.cat([values.index_copy(0, rows, first_half), second_half])

    coefficients = scene.spherical_harmonics
    if coefficients is not None:
        coefficients = torch.cat([coefficients, coefficients[rows]])
    return replace(
        scene,
        gaussians=map_attributes(join, scene.gaussians, first, second),
        nodes=torch.cat([scene.nodes, scene.nodes[rows]]),
        spherical_harmonics=coefficients,
    )


def _visible_log_scales(gaussians: Gaussians, axes: Tensor) -> Tensor:
    """Log-scales [N, 3] across the line of sight from the chunk's origin, which is on the path."""
    direction = torch.nn.functional.normalize(gaussians.means, dim=1)
    # Halves one behind the other would look like their parent.
    along = torch.einsum("nda,nd->na", axes, direction)
    return gaussians.log_scales + 0.5 * (1.0 - along.square()).clamp_min(_LEAST_ACROSS).log()
