"""How actors' shapes depart from rigid ones, frame by frame: offsets of a lattice of control points in the box frame.

Free-form deformation (Sederberg and Parry 1986) with trilinear weights: the lattice's outer nodes are the box's faces,
and what lies outside of the box moves as the nearest face does.
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

    ``actors`` [A]: their numbers in the scene graph; ``sizes_m`` [A, 3] of their boxes; ``frames`` [K] log frames in
    rising order, ``known`` [A, K] whether an actor has offsets of its own there. Elsewhere they are interpolated
    linearly between its nearest frames in time, and those of the nearest beyond the first and the last.
    """

    actors: tuple[int, ...]
    sizes_m: Tensor  # [A, 3]
    frames: tuple[int, ...]
    known: NDArray[np.bool_]
    offsets: Tensor  # [A, K, NODES, 3] metres; nodes count up along z first, then y, then x

    @staticmethod
    def none(path_of: Sequence[ActorNode], actors: tuple[int, ...], frames: tuple[int, ...]) -> Deformation:
        """Offsets of zero of ``actors``, numbers in ``path_of``, at those of the frames where each one exists."""
        own = [path_of[k] for k in actors]
        sizes = torch.tensor([actor.size_m for actor in own], dtype=torch.float32).reshape(-1, 3)
        known = np.array([np.isin(frames, actor.frames) for actor in own], bool).reshape(len(own), len(frames))
        return Deformation(actors, sizes, frames, known, torch.zeros(len(own), len(frames), NODES, 3))

    def with_offsets(self, offsets: Tensor) -> Deformation:
        """The same with other offsets [A, K, NODES, 3]."""
        return replace(self, offsets=offsets)

    def rows(self, actor_of: Tensor) -> tuple[Tensor, Tensor]:
        """Which of Gaussians deform, given the number of each one's actor [M], and as which of A."""
        own = torch.tensor(self.actors, dtype=torch.int64, device=actor_of.device)
        found = torch.nonzero(actor_of[:, None] == own)
        return found[:, 0], found[:, 1]

    def shifts(self, means: Tensor, of: Tensor, frames: Sequence[float]) -> Tensor:
        """[F, M, 3] metres in box axes that Gaussians at ``means`` [M, 3] in their boxes move by, at log frames.

        ``of`` [M]: whose they are, among A. Differentiable in ``means`` and ``offsets``. The same bits at any number of
        frames.
        """
        nodes = self.at(frames).index_select(1, of)
        share = weights(means, self.sizes_m.to(means)[of])
        # Written out: the bits of a batched product depend on the size of its batch.
        out = share[:, 0, None] * nodes[:, :, 0]
        for k in range(1, NODES):
            out = out + share[:, k, None] * nodes[:, :, k]
        return out

    def at(self, frames: Sequence[float]) -> Tensor:
        """[F, A, NODES, 3] the offsets at log frames."""
        before, after, part = (torch.from_numpy(x).to(self.offsets.device) for x in self.between(frames))
        rows = torch.arange(len(self.actors), device=self.offsets.device)
        part = part.to(self.offsets)[..., None, None]
        return (1 - part) * self.offsets[rows, before] + part * self.offsets[rows, after]

    def between(self, frames: Sequence[float]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Before and after [F, A], of K, and how far from the one to the other the frame lies."""
        before, after = np.zeros((2, len(frames), len(self.actors)), np.int64)
        part = np.zeros(before.shape)
        for a, own in enumerate(np.flatnonzero(k) for k in self.known):
            times = [self.frames[k] for k in own]
            for f, frame in enumerate(frames if len(own) else ()):
                high = bisect.bisect_left(times, frame)
                low, high = max(high - 1, 0), min(high, len(own) - 1)
                before[f, a], after[f, a] = own[low], own[high]
                span = times[high] - times[low]
                part[f, a] = min(max((frame - times[low]) / span, 0.0), 1.0) if span else 0.0
        return before, after, part


def weights(means: Tensor, sizes_m: Tensor) -> Tensor:
    """Trilinear weights [M, NODES] at places [M, 3] in boxes [M, 3]; their sum is 1."""
    parts = (means / sizes_m + 0.5).clamp(0, 1)
    x, y, z = (
        (1 - (parts[:, k, None] * (n - 1) - torch.arange(n, device=means.device)).abs()).clamp_min(0)
        for k, n in enumerate(LATTICE)
    )
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
