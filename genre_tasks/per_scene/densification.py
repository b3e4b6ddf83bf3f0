"""Density control of per-scene 3DGS: Gaussians are cloned, split and pruned (Kerbl et al. 2023, Sec. 5.2).

As gsplat's ``DefaultStrategy`` does it by default. The distant region keeps its number: it is neither grown, pruned nor
reset. Whoever is new belongs to its parent's node; lengths are compared with the node's own extent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.config import DensityConfig
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import DISTANT
from genre_tasks.scene.rotations import rotation_matrices

SPLIT_SHRINK = 1.6
"""Both halves of a split are smaller by this (Kerbl et al.)."""


@dataclass(frozen=True)
class Population:
    """The Gaussians in training with Adam's two moments of each, row by row; ``nodes`` [N] as ``SceneGraph.nodes``."""

    gaussians: Gaussians
    first: Gaussians
    second: Gaussians
    nodes: Tensor

    @staticmethod
    def newborn(gaussians: Gaussians, nodes: Tensor) -> Population:
        """Without memory."""
        return Population(
            gaussians, map_attributes(torch.zeros_like, gaussians), map_attributes(torch.zeros_like, gaussians), nodes
        )

    def __len__(self) -> int:
        return len(self.nodes)

    def rows(self, index: Tensor) -> Population:
        """Those that ``index`` (a mask or indices) picks."""
        gaussians, first, second = (
            map_attributes(lambda x: x[index], g) for g in (self.gaussians, self.first, self.second)
        )
        return Population(gaussians, first, second, self.nodes[index])

    @staticmethod
    def joined(*parts: Population) -> Population:
        """One after the other."""
        columns = zip(*((p.gaussians, p.first, p.second) for p in parts), strict=True)
        gaussians, first, second = (map_attributes(lambda *x: torch.cat(x), *column) for column in columns)
        return Population(gaussians, first, second, torch.cat([p.nodes for p in parts]))


def grown(
    population: Population,
    pull: Tensor,  # [N] mean screen-space gradient, see genre_tasks.per_scene.screen_gradient
    extent: Tensor,  # [N] metres, of each Gaussian's node
    config: DensityConfig,
    generator: torch.Generator,
) -> Population:
    """Those pulled harder than ``grow_gradient``: the small are cloned, the large split into two samples of themselves.

    Each adds one. Where that would pass ``max_gaussians``, those pulled hardest come first.
    """
    high = (pull > config.grow_gradient) & (population.nodes != DISTANT)
    room = max(config.max_gaussians - len(population), 0)
    if int(high.sum()) > room:
        order = torch.argsort(torch.where(high, pull, torch.zeros_like(pull)), descending=True, stable=True)
        high = torch.zeros_like(high).index_fill_(0, order[:room], True)
    large = _largest(population) > config.grow_scale * extent
    clones, parents = population.rows(high & ~large), population.rows(high & large)
    halves = [Population.newborn(_sample(parents.gaussians, generator), parents.nodes) for _ in range(2)]
    clones = Population.newborn(clones.gaussians, clones.nodes)
    return Population.joined(population.rows(~(high & large)), clones, *halves)


def pruned(population: Population, extent: Tensor, config: DensityConfig, too_large: bool) -> Population:
    """Without the transparent and, where ``too_large``, without those above ``prune_scale`` of their node's extent."""
    gone = population.gaussians.logit_opacities < _logit(config.prune_opacity)
    if too_large:
        gone = gone | (_largest(population) > config.prune_scale * extent)
    return population.rows(~gone | (population.nodes == DISTANT))


def reset(population: Population, config: DensityConfig) -> Population:
    """Opacities lowered to at most twice ``prune_opacity``, and their moments forgotten."""
    distant, opacities = population.nodes == DISTANT, population.gaussians.logit_opacities
    low = torch.where(distant, opacities, opacities.clamp_max(_logit(2 * config.prune_opacity)))
    first, second = (
        replace(g, logit_opacities=torch.where(distant, g.logit_opacities, 0.0))
        for g in (population.first, population.second)
    )
    return Population(replace(population.gaussians, logit_opacities=low), first, second, population.nodes)


def _largest(population: Population) -> Tensor:
    return population.gaussians.log_scales.amax(1).exp()


def _sample(g: Gaussians, generator: torch.Generator) -> Gaussians:
    """A Gaussian drawn from within each Gaussian, smaller by ``SPLIT_SHRINK``, otherwise its parent's copy."""
    noise = torch.randn((len(g), 3), generator=generator) * g.log_scales.exp()
    turn = rotation_matrices(g.quats)
    move = turn[:, :, 0] * noise[:, :1] + turn[:, :, 1] * noise[:, 1:2] + turn[:, :, 2] * noise[:, 2:]
    return replace(g, means=g.means + move, log_scales=g.log_scales - math.log(SPLIT_SHRINK))


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))
