"""How actors' shapes depart from rigid ones, frame by frame: offsets of a lattice of control points in the box frame.

Free-form deformation (Sederberg and Parry 1986) with trilinear weights. The lattice's outer nodes lie on the box's
faces; what is outside of the box moves as the nearest face does.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.scene.actor_node import ActorNode

LATTICE = (2, 2, 4)
"""Nodes along the box's length, width and height."""

NODES = prod(LATTICE)


@dataclass(frozen=True)
class Deformation:
    """Offsets of the control points of some of a scene's actors, in box axes.

    Where an actor has no offsets of its own, they are interpolated linearly between its nearest frames in time; before
    the first of them and after the last one, that frame's offsets hold.

    Attributes:
        actors: [A] the deforming actors' numbers in the scene graph.
        sizes_m: [A, 3] length, width and height of their boxes.
        frames: [K] log frames in rising order.
        known: [A, K] whether an actor has offsets of its own at a frame.
        offsets: [A, K, NODES, 3] metres; nodes count up along z first, then y, then x.
    """

    actors: tuple[int, ...]
    sizes_m: Tensor
    frames: tuple[int, ...]
    known: NDArray[np.bool_]
    offsets: Tensor

    @staticmethod
    def zero(nodes: Sequence[ActorNode], actors: tuple[int, ...], frames: tuple[int, ...]) -> Deformation:
        """Makes the deformation that an optimisation starts from: all offsets are 0.

        Args:
            nodes: all actors of the scene graph.
            actors: the numbers in ``nodes`` of those that deform.
            frames: log frames; an actor has offsets at those of them where it exists.
        """
        deforming = [nodes[k] for k in actors]
        sizes = torch.tensor([node.size_m for node in deforming], dtype=torch.float32).reshape(-1, 3)
        known = np.array([np.isin(frames, node.frames) for node in deforming], bool)
        # An empty list gives an array of one dimension, which later indexing would refuse.
        known = known.reshape(len(deforming), len(frames))
        return Deformation(actors, sizes, frames, known, torch.zeros(len(deforming), len(frames), NODES, 3))

    def with_offsets(self, offsets: Tensor) -> Deformation:
        """The same deformation with other offsets [A, K, NODES, 3]."""
        return replace(self, offsets=offsets)

    def select_gaussians(self, actor_of: Tensor) -> tuple[Tensor, Tensor]:
        """Finds the Gaussians that deform.

        Args:
            actor_of: [M] the number in the scene graph of each Gaussian's actor.

        Returns:
            Indices [L] of the Gaussians that deform, and which of the A deforming actors each belongs to [L].
        """
        # A table of M × A comparisons, since few actors deform.
        deforming = torch.tensor(self.actors, dtype=torch.int64, device=actor_of.device)
        found = torch.nonzero(actor_of[:, None] == deforming)
        return found[:, 0], found[:, 1]

    def displacements(self, means: Tensor, owner: Tensor, frames: Sequence[float]) -> Tensor:
        """Computes by how much Gaussians move at log frames; differentiable in ``means`` and ``offsets``.

        Args:
            means: [L, 3] metres, in the boxes of their actors.
            owner: [L] which of the A deforming actors each belongs to.
            frames: [F] log frames.

        Returns:
            [F, L, 3] metres in box axes; the same bits at any number of frames.
        """
        nodes = self.offsets_at(frames).index_select(1, owner)
        weights = trilinear_weights(means, self.sizes_m.to(means)[owner])
        # Written out: the bits of a batched product depend on the size of its batch.
        out = weights[:, 0, None] * nodes[:, :, 0]
        for k in range(1, NODES):
            out = out + weights[:, k, None] * nodes[:, :, k]
        return out

    def offsets_at(self, frames: Sequence[float]) -> Tensor:
        """Interpolates the offsets in time.

        Args:
            frames: [F] log frames, or moments between them.

        Returns:
            [F, A, NODES, 3] metres.
        """
        brackets = (torch.from_numpy(x).to(self.offsets.device) for x in self.bracket_frames(frames))
        before, after, fraction = brackets
        # Indexed by actor and frame at once: [F, A] picks from [A, K].
        rows = torch.arange(len(self.actors), device=self.offsets.device)
        fraction = fraction.to(self.offsets)[..., None, None]
        # Both weights are written out, so that a fraction of 0 or 1 gives exactly one frame's offsets.
        return (1 - fraction) * self.offsets[rows, before] + fraction * self.offsets[rows, after]

    def bracket_frames(
        self, frames: Sequence[float]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Finds between which of each actor's own frames some log frames lie.

        Args:
            frames: [F] log frames, or moments between them.

        Returns:
            Indices [F, A] into ``self.frames`` of the frame before and of the one after, and how far from the one to
            the other the frame lies [F, A], in [0, 1].
        """
        before = np.zeros((len(frames), len(self.actors)), np.int64)
        after = np.zeros_like(before)
        fraction = np.zeros(before.shape)
        for a, known in enumerate(self.known):
            indices = np.flatnonzero(known)
            # An actor that exists at none of the frames keeps index 0, where nothing was fitted.
            if not len(indices):
                continue
            # An actor's own frames only: at a frame of others' its offsets were never fitted.
            times = [self.frames[k] for k in indices]
            for f, frame in enumerate(frames):
                next_index = bisect.bisect_left(times, frame)
                low = max(next_index - 1, 0)
                high = min(next_index, len(indices) - 1)
                before[f, a] = indices[low]
                after[f, a] = indices[high]
                span = times[high] - times[low]
                fraction[f, a] = min(max((frame - times[low]) / span, 0.0), 1.0) if span else 0.0
        return before, after, fraction


def trilinear_weights(points: Tensor, sizes_m: Tensor) -> Tensor:
    """Computes how much each node of the lattice counts at points of a box.

    Args:
        points: [M, 3] metres, in box coordinates; those outside count as on the nearest face.
        sizes_m: [M, 3] length, width and height of each point's box.

    Returns:
        Weights [M, NODES], whose sum over the nodes is 1.

    >>> weights = trilinear_weights(torch.zeros(1, 3), torch.ones(1, 3))  # the box's centre
    >>> weights.shape, float(weights.sum())
    (torch.Size([1, 16]), 1.0)
    """
    # Clamped, because extrapolated weights would fling away points that annotations leave outside of their box.
    position = (points / sizes_m + 0.5).clamp(0, 1)
    x, y, z = (
        (1 - (position[:, k, None] * (n - 1) - torch.arange(n, device=points.device)).abs()).clamp_min(0)
        for k, n in enumerate(LATTICE)
    )
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
