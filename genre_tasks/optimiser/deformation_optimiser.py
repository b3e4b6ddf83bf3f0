"""Actors' deformation in an unrolled optimisation: its share of a compiled pass, and the steps that fit it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float32
from genre_tasks.optimiser.state import SECOND_DECAY, Frame
from genre_tasks.optimiser.step_rules import schedule
from genre_tasks.scene.deformation import LATTICE, Deformation
from genre_tasks.scene.graph import FIRST_ACTOR

RATE_M = 0.1
"""How far a control point whose gradient is as large as its actor's mostly are moves in a step at the start."""

SMOOTH = 0.4
"""How far towards the mean of its neighbours in time a step takes an offset at the start."""


class Shift:
    """What a deformation does to the splats of a compiled pass, and the way back.

    ``SceneGraph.posed`` is its oracle, within rounding: here an actor's Gaussians are turned before they are shifted.
    By numpy: torch's threads would wake for each of its steps and then spin beside the kernels'.
    """

    def __init__(
        self,
        frame: Frame,
        offsets: Tensor,  # [N, 14]
        frames: Sequence[float],  # [F], distinct
        means: Tensor,  # [S + F · M, 3] of the splats, as by SceneGraph.posed; shifted in place
        deformation: Deformation,
    ) -> None:
        posing, nodes = frame.posing, frame.scene.nodes.numpy()
        moving = np.flatnonzero(nodes >= FIRST_ACTOR)
        rank = np.full(len(frame.scene.actors), -1)
        rank[list(deformation.actors)] = np.arange(len(deformation.actors))
        of = rank[nodes[moving] - FIRST_ACTOR]
        own = np.flatnonzero(of >= 0)
        self._rows, self._of = moving[own], of[own]
        self._slots = posing.still + np.arange(len(frames))[:, None] * posing.moving + own
        self._unit = frame.unit.numpy()[self._rows]
        at = frame.start.numpy()[self._rows, :3] + offsets.numpy()[self._rows, :3] * self._unit
        self._weights, self._slopes = weights_and_slopes(at, deformation.sizes_m.numpy()[self._of])
        self._between, self._like = deformation.between(frames), deformation.offsets
        self._nodes = deformation.at(frames).numpy()
        turns = frame.scene.actor_poses(frames)[0].astype(np.float32)
        self._turns = turns[:, list(deformation.actors)]
        for f, slots in enumerate(self._slots):
            shifts = np.einsum("mc,mcd->md", self._weights, self._nodes[f][self._of])
            means.numpy()[slots] += np.einsum("mij,mj->mi", self._turns[f][self._of], shifts)

    def gradient(self, by_means: Tensor, by_offsets: Tensor) -> Tensor:
        """By the control points' offsets; what the means of Gaussians have of it is added to ``by_offsets`` [N, 14]."""
        by_at = np.zeros((len(self._rows), 3), np.float32)
        by_nodes = torch.zeros_like(self._like)
        rows = np.arange(len(by_nodes))
        for f, slots in enumerate(self._slots):
            by_shift = np.einsum("mij,mi->mj", self._turns[f][self._of], by_means.numpy()[slots])
            along = np.einsum("mcd,md->mc", self._nodes[f][self._of], by_shift)
            by_at += np.einsum("mck,mc->mk", self._slopes, along)
            own = np.zeros(self._nodes.shape[1:], np.float32)
            for a in np.unique(self._of):
                mine = self._of == a
                own[a] = np.einsum("mc,md->cd", self._weights[mine], by_shift[mine])
            before, after, part = (x[f] for x in self._between)
            share = part.astype(np.float32)[:, None, None]
            by_nodes.numpy()[rows, before] += (1 - share) * own
            by_nodes.numpy()[rows, after] += share * own
        by_offsets.numpy()[self._rows, :3] += by_at * self._unit
        return by_nodes


def weights_and_slopes(at: Float32, sizes_m: Float32) -> tuple[Float32, Float32]:
    """The weights [M, NODES] of ``deformation.weights`` at places [M, 3], and their derivatives [M, NODES, 3]."""
    parts = at / sizes_m + np.float32(0.5)
    hats: list[Float32] = []
    slopes: list[Float32] = []
    for k, n in enumerate(LATTICE):
        off = parts[:, k, None].clip(0, 1) * (n - 1) - np.arange(n, dtype=np.float32)
        inside = (np.abs(off) < 1) & (parts[:, k, None] > 0) & (parts[:, k, None] < 1)
        hats.append(np.maximum(1 - np.abs(off), 0).astype(np.float32))
        slopes.append((-np.sign(off) * inside * (n - 1) / sizes_m[:, k, None]).astype(np.float32))

    def product(x: Float32, y: Float32, z: Float32) -> Float32:
        out = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return out.reshape(len(at), -1)

    (x, y, z), (dx, dy, dz) = hats, slopes
    return product(x, y, z), np.stack([product(dx, y, z), product(x, dy, z), product(x, y, dz)], -1)


class DeformationFit:
    """Steps beside the step rule's: gradients over their root mean square so far, as RMSprop's, without momentum.

    One root mean square for all control points of an actor at a frame: where few Gaussians are, few pull. Only the
    iterations that saw an actor at a frame count there, some five to ten: a direction kept from an earlier one leads on
    what its neighbours in time have since corrected.
    """

    def __init__(self, deformation: Deformation) -> None:
        self.deformation = deformation
        self._second = torch.zeros_like(deformation.offsets[..., :1, :1])
        self._seen = torch.zeros_like(self._second)
        self._known = torch.from_numpy(deformation.known).to(self._seen)[..., None, None]

    def step(self, gradient: Tensor, iteration: int, total: int) -> None:
        """Takes the gradient [A, K, NODES, 3] of that iteration of ``total``."""
        now = (gradient != 0).flatten(2).any(2)[..., None, None].to(gradient)
        self._seen += now
        square = gradient.square().mean((2, 3), keepdim=True)
        self._second += now * (1 - SECOND_DECAY) * (square - self._second)
        deviation = (self._second / (1 - SECOND_DECAY ** self._seen.clamp_min(1))).sqrt()
        direction = now * gradient / torch.where(deviation > 0, deviation, 1.0)
        part, offsets = schedule(iteration, total), self.deformation.offsets
        offsets = offsets - RATE_M * part * direction
        offsets = offsets + part * SMOOTH * self._known * (self._beside(offsets) - offsets)
        self.deformation = self.deformation.with_offsets(offsets)

    def _beside(self, offsets: Tensor) -> Tensor:
        """The mean of what is known of the frames before and after; the offsets themselves where that is nothing."""
        total, count = torch.zeros_like(offsets), torch.zeros_like(self._known)
        for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            total[:, here] += (self._known * offsets)[:, there]
            count[:, here] += self._known[:, there]
        return torch.where(count > 0, total / count.clamp_min(1), offsets)
