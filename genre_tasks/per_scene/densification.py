"""Density control of per-scene 3DGS: Gaussians are cloned, split and pruned (Kerbl et al. 2023, Sec. 5.2).

The rules are those that gsplat's ``DefaultStrategy`` has by default, with three differences for scene graphs. The
distant region keeps its number of Gaussians: they are neither cloned, split, pruned nor made transparent. A new
Gaussian belongs to its parent's node. Sizes are compared with the extent of the Gaussian's own node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.config import DensityConfig
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import DISTANT
from genre_tasks.scene.rotations import quats_to_matrices

SPLIT_SHRINK = 1.6
"""Both halves of a split are smaller than their parent by this factor (Kerbl et al. 2023)."""


@dataclass(frozen=True)
class GaussiansWithMoments:
    """Gaussians in training with Adam's two moments of each attribute, row by row.

    Attributes:
        gaussians: the N Gaussians in raw space.
        first_moments: Adam's running mean of their gradients.
        second_moments: Adam's running mean of their squared gradients.
        nodes: [N] the node of each Gaussian, as in ``SceneGraph.nodes``.
    """

    gaussians: Gaussians
    first_moments: Gaussians
    second_moments: Gaussians
    nodes: Tensor

    @staticmethod
    def with_zero_moments(gaussians: Gaussians, nodes: Tensor) -> GaussiansWithMoments:
        """Pairs Gaussians with moments of zero, as Adam starts.

        Args:
            gaussians: N Gaussians; kept, not copied.
            nodes: [N] their nodes.
        """
        first_moments = map_attributes(torch.zeros_like, gaussians)
        second_moments = map_attributes(torch.zeros_like, gaussians)
        return GaussiansWithMoments(gaussians, first_moments, second_moments, nodes)

    def __len__(self) -> int:
        return len(self.nodes)

    def select(self, index: Tensor) -> GaussiansWithMoments:
        """Picks Gaussians together with their moments.

        Args:
            index: a mask [N], or the indices [M] of the Gaussians.

        Returns:
            Copies of the picked rows.
        """

        def pick(attributes: Gaussians) -> Gaussians:
            return map_attributes(lambda x: x[index], attributes)

        return GaussiansWithMoments(
            pick(self.gaussians), pick(self.first_moments), pick(self.second_moments), self.nodes[index]
        )

    @staticmethod
    def concatenate(*parts: GaussiansWithMoments) -> GaussiansWithMoments:
        """Joins sets of Gaussians one after the other.

        Args:
            parts: at least one set.
        """

        def join(*attributes: Gaussians) -> Gaussians:
            return map_attributes(lambda *x: torch.cat(x), *attributes)

        return GaussiansWithMoments(
            join(*(part.gaussians for part in parts)),
            join(*(part.first_moments for part in parts)),
            join(*(part.second_moments for part in parts)),
            torch.cat([part.nodes for part in parts]),
        )


def densify(
    gaussians: GaussiansWithMoments,
    screen_gradient: Tensor,  # [N]
    extent: Tensor,  # [N] metres
    config: DensityConfig,
    generator: torch.Generator,
) -> GaussiansWithMoments:
    """Adds a Gaussian for each one whose screen-space gradient is above ``config.grow_gradient``.

    Small ones are cloned, as the surface around them is not covered yet. Large ones are split into two samples of
    themselves, as they cover what needs detail. New Gaussians start with moments of zero.

    Args:
        gaussians: N Gaussians.
        screen_gradient: mean over views of :func:`genre_tasks.per_scene.screen_gradient.screen_space_gradient`.
        extent: extent of each Gaussian's node; ``config.grow_scale`` times it divides small from large.
        config: thresholds, and the number of Gaussians that is not exceeded: the largest gradients come first.
        generator: draws the means of the split Gaussians.

    Returns:
        The Gaussians that were not split, then the clones, then the halves of the split ones.
    """
    grows = (screen_gradient > config.grow_gradient) & (gaussians.nodes != DISTANT)
    # Each growing Gaussian adds one, be it a clone or a second half.
    room = max(config.max_gaussians - len(gaussians), 0)
    if int(grows.sum()) > room:
        wanted = torch.where(grows, screen_gradient, torch.zeros_like(screen_gradient))
        # Stable, so that equal gradients are taken in the same order in every run.
        order = torch.argsort(wanted, descending=True, stable=True)
        grows = torch.zeros_like(grows).index_fill_(0, order[:room], True)
    # Relative to the own node: a car's Gaussian is large at a size that is small for the street.
    large = _largest_scale(gaussians) > config.grow_scale * extent
    cloned = gaussians.select(grows & ~large)
    parents = gaussians.select(grows & large)
    halves = [
        GaussiansWithMoments.with_zero_moments(_sample_within(parents.gaussians, generator), parents.nodes)
        for _ in range(2)
    ]
    # A clone starts on its parent, and leaves it because it has moments of its own.
    clones = GaussiansWithMoments.with_zero_moments(cloned.gaussians, cloned.nodes)
    return GaussiansWithMoments.concatenate(gaussians.select(~(grows & large)), clones, *halves)


def prune(
    gaussians: GaussiansWithMoments, extent: Tensor, config: DensityConfig, too_large: bool
) -> GaussiansWithMoments:
    """Removes Gaussians that are nearly transparent, and on request those that are too large.

    Args:
        gaussians: N Gaussians.
        extent: [N] metres, extent of each Gaussian's node.
        config: ``prune_opacity``, and ``prune_scale`` as a fraction of the extent.
        too_large: whether Gaussians above ``prune_scale`` go too.

    Returns:
        The Gaussians that stay, in their order.
    """
    # Logits are compared, which saves a sigmoid of every Gaussian.
    removed = gaussians.gaussians.logit_opacities < _logit(config.prune_opacity)
    if too_large:
        removed = removed | (_largest_scale(gaussians) > config.prune_scale * extent)
    return gaussians.select(~removed | (gaussians.nodes == DISTANT))


def reset_opacity(gaussians: GaussiansWithMoments, config: DensityConfig) -> GaussiansWithMoments:
    """Lowers opacities, so that Gaussians which no image needs stay transparent and are pruned.

    Args:
        gaussians: the Gaussians in training.
        config: opacities are lowered to at most twice its ``prune_opacity``.

    Returns:
        The same Gaussians; the moments of the lowered opacities are zero.
    """
    distant = gaussians.nodes == DISTANT

    def forget(moments: Gaussians) -> Gaussians:
        # Momentum towards the old opacity would undo the reset.
        return replace(moments, logit_opacities=torch.where(distant, moments.logit_opacities, 0.0))

    opacities = gaussians.gaussians.logit_opacities
    lowered = torch.where(distant, opacities, opacities.clamp_max(_logit(2 * config.prune_opacity)))
    return GaussiansWithMoments(
        replace(gaussians.gaussians, logit_opacities=lowered),
        forget(gaussians.first_moments),
        forget(gaussians.second_moments),
        gaussians.nodes,
    )


def _largest_scale(gaussians: GaussiansWithMoments) -> Tensor:
    return gaussians.gaussians.log_scales.amax(1).exp()


def _sample_within(parents: Gaussians, generator: torch.Generator) -> Gaussians:
    """One Gaussian drawn from each parent's density, smaller by ``SPLIT_SHRINK``; the rest is the parent's."""
    # Scales are standard deviations along the Gaussian's axes: noise is drawn there, then turned.
    noise = torch.randn((len(parents), 3), generator=generator) * parents.log_scales.exp()
    axes = quats_to_matrices(parents.quats)
    # Written out, since a matrix product splits its sums by the number of threads and so changes the last bits.
    move = axes[:, :, 0] * noise[:, :1] + axes[:, :, 1] * noise[:, 1:2] + axes[:, :, 2] * noise[:, 2:]
    return replace(parents, means=parents.means + move, log_scales=parents.log_scales - math.log(SPLIT_SHRINK))


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))
