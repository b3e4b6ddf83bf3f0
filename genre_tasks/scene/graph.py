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
from genre_tasks.scene.rotations import matrices_to_quats, multiply_quats

if TYPE_CHECKING:
    from genre_tasks.scene.deformation import Deformation

STATIC = 0
DISTANT = 1
FIRST_ACTOR = 2
"""Values of ``SceneGraph.nodes``; actor k has ``FIRST_ACTOR + k``."""

# Frames and moments between them whose velocities of actors are kept.
_MOST_MOTIONS = 4096
DEFAULT_SH_DEGREE = 2
"""Degree of spherical harmonics, where a reconstruction has any."""

SH_COUNTS = {1: 3, 2: 8, 3: 15}
"""How many spherical harmonics there are up to a degree, without the constant one."""


@dataclass(frozen=True)
class SceneGraph:
    """All Gaussians of a scene in one batch, each belonging to one node.

    Attributes:
        gaussians: N of them. Static and distant ones are in chunk coordinates, an actor's in its box frame.
        nodes: [N] int64: ``STATIC``, ``DISTANT`` or ``FIRST_ACTOR + k``.
        actors: A paths and boxes.
        antialiased: whether the scene was made with anti-aliasing, and so is rendered with it: see ``Cameras``.
        deformation: how actors depart from rigid ones; ``None``: none does. It moves means alone, and velocities do
            not include its change.
        spherical_harmonics: [N, K, 3] in each Gaussian's own frame: see ``scene.spherical_harmonics``; ``None``: a
            Gaussian has one colour wherever it is seen from.

    >>> scene = SceneGraph(Gaussians.unpack(torch.zeros(4, 14)), torch.zeros(4, dtype=torch.int64), ())
    >>> len(scene), len(scene.gaussians_at(0))
    (4, 4)
    """

    gaussians: Gaussians
    nodes: Tensor
    actors: tuple[ActorNode, ...]
    antialiased: bool = False
    deformation: Deformation | None = None
    spherical_harmonics: Tensor | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def with_gaussians(self, gaussians: Gaussians) -> SceneGraph:
        """The same graph with other Gaussians, of the same number and order."""
        return replace(self, gaussians=gaussians)

    def with_spherical_harmonics(self, spherical_harmonics: Tensor | None) -> SceneGraph:
        """The same graph with other spherical harmonics [N, K, 3], or none."""
        return replace(self, spherical_harmonics=spherical_harmonics)

    def gaussians_at(self, frame: float) -> Gaussians:
        """Poses all Gaussians at a log frame; differentiable.

        Args:
            frame: log frame, or a moment between two.

        Returns:
            N Gaussians in chunk coordinates, in their order; ``gaussians`` itself without actors. Those of an actor
            that does not exist get a logit opacity of −30: no renderer draws them, and no gradient reaches them.
        """
        g = self.gaussians
        if not self.actors:
            return g
        moving = torch.nonzero(self.nodes >= FIRST_ACTOR)[:, 0]
        # index_copy keeps the order of the Gaussians, which optimisers and artifacts rely on.
        (means,), (quats,), (opacities,) = self._pose_actors(moving, (frame,))
        return Gaussians(
            g.means.index_copy(0, moving, means),
            g.log_scales,
            g.quats.index_copy(0, moving, quats),
            g.logit_opacities.index_copy(0, moving, opacities),
            g.colors,
        )

    def gaussians_at_frames(self, frames: Sequence[float]) -> tuple[Gaussians, Tensor]:
        """Poses all Gaussians at several log frames at once, so that views of several frames share one render.

        Differentiable. What does not move is there once.

        Args:
            frames: [F] distinct log frames, or moments between them.

        Returns:
            S + F · M Gaussians in chunk coordinates: the S that do not move, then the M of the actors as they are at
            the first frame, at the second, and so on; and the indices [M] of the latter. Those of an absent actor are
            as in :meth:`gaussians_at`.
        """
        g = self.gaussians
        moves = self.nodes >= FIRST_ACTOR if self.actors else torch.zeros_like(self.nodes, dtype=torch.bool)
        moving = torch.nonzero(moves)[:, 0]
        if not len(moving):
            return g, moving
        still = torch.nonzero(~moves)[:, 0]
        means, quats, opacities = self._pose_actors(moving, frames)

        # Attributes that an actor's motion does not change are repeated for each frame.
        def join(values: Tensor, moved: Tensor | None = None) -> Tensor:
            if moved is None:
                constant = values.index_select(0, moving)
                moved = constant.expand(len(frames), *constant.shape)
            return torch.cat([values.index_select(0, still), moved.flatten(0, 1)])

        return Gaussians(
            join(g.means, means),
            join(g.log_scales),
            join(g.quats, quats),
            join(g.logit_opacities, opacities),
            join(g.colors),
        ), moving

    def velocities_at(self, means: Tensor, frame: float, frame_s: float) -> Tensor:
        """Computes how fast Gaussians move that are laid out as by :meth:`gaussians_at`; without gradient.

        Args:
            means: [N, 3] metres, chunk coordinates.
            frame: log frame.
            frame_s: seconds to the next log frame; 0: actors count as resting.

        Returns:
            [N, 3] m/s in chunk axes.
        """
        out = np.zeros((len(means), 3), np.float32)
        moving = self._moving_rows
        out[moving] = self._actor_velocities(_to_numpy(means)[moving], frame, frame_s)
        return torch.from_numpy(out).to(means)

    def velocities_at_frames(self, means: Tensor, frames: Sequence[float], frames_s: Sequence[float]) -> Tensor:
        """Computes how fast Gaussians move that are laid out as by :meth:`gaussians_at_frames`; without gradient.

        Args:
            means: [S + F · M, 3] metres, chunk coordinates.
            frames: [F] log frames.
            frames_s: [F] seconds from each of them to the next log frame; 0: actors count as resting.

        Returns:
            [S + F · M, 3] m/s in chunk axes.
        """
        out = np.zeros((len(means), 3), np.float32)
        moving = self._moving_rows
        still_count = len(self) - len(moving)
        for f, (frame, frame_s) in enumerate(zip(frames, frames_s, strict=True)):
            rows = slice(still_count + f * len(moving), still_count + (f + 1) * len(moving))
            out[rows] = self._actor_velocities(_to_numpy(means[rows]), frame, frame_s)
        return torch.from_numpy(out).to(means)

    def actor_poses(self, frames: Sequence[float]) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Gives the poses of all actors' boxes at log frames.

        Args:
            frames: [F] log frames, or moments between them.

        Returns:
            Rotations [F, A, 3, 3], translations [F, A, 3], and whether the actors exist [F, A]. The pose of an absent
            actor is the identity.
        """
        # The identity stands for an absent actor, so that its Gaussians stay finite; their logit hides them.
        rotation = np.broadcast_to(np.eye(3), (len(frames), len(self.actors), 3, 3)).copy()
        translation = np.zeros((len(frames), len(self.actors), 3))
        present = np.zeros((len(frames), len(self.actors)), dtype=bool)
        for k, actor in enumerate(self.actors):
            for f, frame in enumerate(frames):
                pose = actor.pose(frame)
                if pose is not None:
                    rotation[f, k] = pose[:3, :3]
                    translation[f, k] = pose[:3, 3]
                    present[f, k] = True
        return rotation, translation, present

    def _actor_velocities(self, means: Float32, frame: float, frame_s: float) -> Float32:
        # [M, 3] m/s of the actors' Gaussians at `means` [M, 3]. By numpy: it is needed in every iteration, and torch's
        # threads would wake for it and then spin beside the kernels'.
        if not frame_s or not len(means):
            return np.zeros_like(means)
        if frame not in self._motions:
            centres = self.actor_poses((frame,))[1][0]
            velocity, turn = (np.stack(x) for x in zip(*(a.motion(frame) for a in self.actors), strict=True))
            constant = velocity - np.cross(turn, centres)  # v + ω × (p − c) = (v − ω × c) + ω × p
            # A simulator may ask for moments without end.
            if len(self._motions) >= _MOST_MOTIONS:
                self._motions.clear()
            self._motions[frame] = constant.astype(np.float32), turn.astype(np.float32)
        constant, turn = (x[self._moving_owners] for x in self._motions[frame])
        x, y, z = means.T
        wx, wy, wz = turn.T
        out = constant + np.stack([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x], 1)
        return np.asarray(out / np.float32(frame_s))

    @cached_property
    def _motions(self) -> dict[float, tuple[Float32, Float32]]:
        # By frame, for each actor: the part of its velocity that does not depend on the position, and its turn [A, 3].
        return {}

    @cached_property
    def _moving_rows(self) -> NDArray[np.int64]:
        # Indices of the actors' Gaussians.
        return np.flatnonzero(self.nodes.cpu().numpy() >= FIRST_ACTOR) if self.actors else np.zeros(0, np.int64)

    @cached_property
    def _moving_owners(self) -> NDArray[np.int64]:
        # The actor that each Gaussian of _moving_rows belongs to.
        return np.asarray(self.nodes.cpu().numpy()[self._moving_rows] - FIRST_ACTOR)

    def _pose_actors(self, moving: Tensor, frames: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
        # Means [F, M, 3], quaternions [F, M, 4] and logit opacities [F, M] of the actors' Gaussians `moving` [M].
        g = self.gaussians
        rotation, translation, present = self.actor_poses(frames)
        actor_of = self.nodes[moving] - FIRST_ACTOR
        # One conversion for each actor and frame, then by index for each Gaussian: actors are few.
        rotations = torch.as_tensor(rotation).to(g.means)
        turn = rotations[:, actor_of]
        turn_quats = matrices_to_quats(rotations)[:, actor_of]
        means = g.means[moving]
        quats = g.quats[moving]
        opacities = g.logit_opacities[moving]
        if self.deformation is not None:
            means = self._deform(self.deformation, means, actor_of, frames)
        x, y, z = (means[..., None, k] for k in range(3))
        # Written out: the bits of a batched product depend on the size of its batch.
        turned = turn[..., 0] * x + turn[..., 1] * y + turn[..., 2] * z
        exists = torch.as_tensor(present, device=means.device)[:, actor_of]
        return (
            turned + torch.as_tensor(translation).to(means)[:, actor_of],
            multiply_quats(turn_quats, quats.expand_as(turn_quats)),
            torch.where(exists, opacities, torch.full_like(opacities, ABSENT_LOGIT)),
        )

    @staticmethod
    def _deform(deformation: Deformation, means: Tensor, actor_of: Tensor, frames: Sequence[float]) -> Tensor:
        # [F, M, 3] in box frames, from means [M, 3].
        rows, owner = deformation.select_gaussians(actor_of)
        # Shifted in the box frame, before the actor is posed: a deformation turns with its actor.
        at_frames = means.expand(len(frames), *means.shape)
        return at_frames.index_add(1, rows, deformation.displacements(means[rows], owner, frames))


def _to_numpy(values: Tensor) -> Float32:
    return np.asarray(values.detach().cpu().float().numpy())
