"""The scene graph: static background G_B, actors G_A in their box frames, distant region G_D (paper Sec. III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.constants import ABSENT_LOGIT
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.transforms import matrix_to_quat, quat_multiply

if TYPE_CHECKING:
    from genre_tasks.scene.deformation import Deformation

STATIC, DISTANT, FIRST_ACTOR = 0, 1, 2
"""Values of ``SceneGraph.nodes``; actor k has ``FIRST_ACTOR + k``."""

DEGREE, COUNTS = 2, {1: 3, 2: 8, 3: 15}
"""Of spherical harmonics, where a reconstruction has any; how many there are up to a degree, without the constant."""


@dataclass(frozen=True)
class SceneGraph:
    """All Gaussians in one batch, each belonging to one node.

    ``nodes`` [N] int64: ``STATIC``, ``DISTANT`` or ``FIRST_ACTOR + k``. Static and distant Gaussians are in chunk
    coordinates, an actor's in its box frame, and so are directions of ``harmonics`` (see ``scene.harmonics``).
    ``antialiased``: how it was made, and so how it is rendered: see ``render.Cameras``. ``deformation``: how actors
    depart from rigid ones, ``None`` where none does; means alone move with it, and velocities know nothing of it.
    """

    gaussians: Gaussians
    nodes: Tensor  # [N] int64
    actors: tuple[ActorNode, ...]
    antialiased: bool = False
    deformation: Deformation | None = None
    harmonics: Tensor | None = None  # [N, K, 3]; None: a Gaussian has one colour wherever it is seen from

    def __len__(self) -> int:
        return len(self.gaussians)

    def with_gaussians(self, gaussians: Gaussians) -> SceneGraph:
        """The same graph with other Gaussians (same N and order)."""
        return replace(self, gaussians=gaussians)

    def with_harmonics(self, harmonics: Tensor | None) -> SceneGraph:
        """The same graph with other harmonics [N, K, 3], or none."""
        return replace(self, harmonics=harmonics)

    def posed(self, frames: Sequence[float]) -> tuple[Gaussians, Tensor]:
        """All Gaussians in chunk coordinates at several log frames at once, differentiable.

        First those that do not move, then those of the actors as they are at the first frame, at the second, and so on;
        with them the numbers [M] of the actors' Gaussians. Those of an absent actor are as in :meth:`at`.
        """
        g = self.gaussians
        moves = self.nodes >= FIRST_ACTOR if self.actors else torch.zeros_like(self.nodes, dtype=torch.bool)
        moving = torch.nonzero(moves)[:, 0]
        if not len(moving):
            return g, moving
        still = torch.nonzero(~moves)[:, 0]
        means, quats, opacities = self._actors_at(moving, frames)

        def joined(values: Tensor, moved: Tensor | None = None) -> Tensor:
            if moved is None:
                own = values.index_select(0, moving)
                moved = own.expand(len(frames), *own.shape)
            return torch.cat([values.index_select(0, still), moved.flatten(0, 1)])

        return Gaussians(
            joined(g.means, means),
            joined(g.log_scales),
            joined(g.quats, quats),
            joined(g.logit_opacities, opacities),
            joined(g.colors),
        ), moving

    def velocities(self, means: Tensor, frames: Sequence[float], frames_s: Sequence[float]) -> Tensor:
        """[S + F · M, 3] m/s in chunk axes, of Gaussians at ``means`` that are laid out as by :meth:`posed`.

        ``frames_s`` [F]: the time from each of the log frames to the next; 0 where actors count as resting. Constants:
        no gradient.
        """
        out = np.zeros((len(means), 3), np.float32)
        moving = self._actors_rows
        begin = len(self) - len(moving)
        for f, (frame, frame_s) in enumerate(zip(frames, frames_s, strict=True)):
            rows = slice(begin + f * len(moving), begin + (f + 1) * len(moving))
            out[rows] = self._actor_velocities(_array(means[rows]), frame, frame_s)
        return torch.from_numpy(out).to(means)

    def velocities_at(self, means: Tensor, frame: float, frame_s: float) -> Tensor:
        """As :meth:`velocities`, [N, 3], of Gaussians that are laid out as by :meth:`at`."""
        out, moving = np.zeros((len(means), 3), np.float32), self._actors_rows
        out[moving] = self._actor_velocities(_array(means)[moving], frame, frame_s)
        return torch.from_numpy(out).to(means)

    def at(self, frame: float) -> Gaussians:
        """All Gaussians in chunk coordinates at a log frame, N kept and order kept, differentiable.

        Gaussians of an actor that does not exist at ``frame`` get a logit opacity of −30: no renderer draws them, and
        no gradient reaches them. Without actors this returns ``gaussians`` itself.
        """
        g = self.gaussians
        if not self.actors:
            return g
        moving = torch.nonzero(self.nodes >= FIRST_ACTOR)[:, 0]
        (means,), (quats,), (opacities,) = self._actors_at(moving, (frame,))
        return Gaussians(
            g.means.index_copy(0, moving, means),
            g.log_scales,
            g.quats.index_copy(0, moving, quats),
            g.logit_opacities.index_copy(0, moving, opacities),
            g.colors,
        )

    def actor_poses(self, frames: Sequence[float]) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Rotations [F, A, 3, 3] and translations [F, A, 3] of the actors' boxes, and whether the actors exist [F, A].

        The pose of an absent actor is the identity.
        """
        rotation = np.broadcast_to(np.eye(3), (len(frames), len(self.actors), 3, 3)).copy()
        translation = np.zeros((len(frames), len(self.actors), 3))
        present = np.zeros((len(frames), len(self.actors)), dtype=bool)
        for k, actor in enumerate(self.actors):
            for f, frame in enumerate(frames):
                pose = actor.pose(frame)
                if pose is not None:
                    rotation[f, k], translation[f, k], present[f, k] = pose[:3, :3], pose[:3, 3], True
        return rotation, translation, present

    def _actor_velocities(self, means: Float32, frame: float, frame_s: float) -> Float32:
        """[M, 3] of the actors' Gaussians at ``means`` [M, 3]. By numpy: it is asked in every iteration, and torch's
        threads would wake for it and then spin beside the kernels'."""
        if not frame_s or not len(means):
            return np.zeros_like(means)
        if frame not in self._motions:
            centres = self.actor_poses((frame,))[1][0]
            velocity, turn = (np.stack(x) for x in zip(*(a.motion(frame) for a in self.actors), strict=True))
            rest = velocity - np.cross(turn, centres)  # v + ω × (p − c) = (v − ω × c) + ω × p
            self._motions[frame] = rest.astype(np.float32), turn.astype(np.float32)
        rest, turn = (x[self._actors_rows_of] for x in self._motions[frame])
        x, y, z = means.T
        wx, wy, wz = turn.T
        out = rest + np.stack([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x], 1)
        return np.asarray(out / np.float32(frame_s))

    @cached_property
    def _motions(self) -> dict[float, tuple[Float32, Float32]]:
        """By frame, of each actor: what of its velocity does not depend on the place, and its turn [A, 3]."""
        return {}

    @cached_property
    def _actors_rows(self) -> NDArray[np.int64]:
        """The actors' Gaussians."""
        return np.flatnonzero(self.nodes.cpu().numpy() >= FIRST_ACTOR) if self.actors else np.zeros(0, np.int64)

    @cached_property
    def _actors_rows_of(self) -> NDArray[np.int64]:
        """Whose each of :attr:`_actors_rows` is."""
        return np.asarray(self.nodes.cpu().numpy()[self._actors_rows] - FIRST_ACTOR)

    def _actors_at(self, moving: Tensor, frames: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
        """Means [F, M, 3], quaternions [F, M, 4] and logit opacities [F, M] of the actors' Gaussians ``moving`` [M]."""
        g = self.gaussians
        rotation, translation, present = self.actor_poses(frames)
        actor_of = self.nodes[moving] - FIRST_ACTOR
        turns = torch.as_tensor(rotation).to(g.means)
        turn, quat = turns[:, actor_of], matrix_to_quat(turns)[:, actor_of]
        means, quats, opacities = g.means[moving], g.quats[moving], g.logit_opacities[moving]
        if self.deformation is not None:
            means = self._deformed(self.deformation, means, actor_of, frames)
        x, y, z = (means[..., None, k] for k in range(3))
        # Written out: the bits of a batched product depend on the size of its batch.
        turned = turn[..., 0] * x + turn[..., 1] * y + turn[..., 2] * z
        there = torch.as_tensor(present, device=means.device)[:, actor_of]
        return (
            turned + torch.as_tensor(translation).to(means)[:, actor_of],
            quat_multiply(quat, quats.expand_as(quat)),
            torch.where(there, opacities, torch.full_like(opacities, ABSENT_LOGIT)),
        )

    @staticmethod
    def _deformed(by: Deformation, means: Tensor, actor_of: Tensor, frames: Sequence[float]) -> Tensor:
        """[F, M, 3] in box frames, of means [M, 3]."""
        rows, of = by.rows(actor_of)
        every = means.expand(len(frames), *means.shape)
        return every.index_add(1, rows, by.shifts(means[rows], of, frames))


def _array(values: Tensor) -> Float32:
    return np.asarray(values.detach().cpu().float().numpy())
