"""The scene graph: static background G_B, actors G_A in their box frames, distant region G_D (paper Sec. III-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.geometry import matrix_to_quat, quat_multiply

STATIC, DISTANT, FIRST_ACTOR = 0, 1, 2
"""Values of ``SceneGraph.nodes``; actor k has ``FIRST_ACTOR + k``."""


@dataclass(frozen=True)
class ActorNode:
    """An actor's path: ``frames`` [F] log frames, ``chunk_SE3_box`` [F, 4, 4] float64."""

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    chunk_SE3_box: Float64

    def pose(self, frame: int) -> Float64 | None:
        """[4, 4] at a log frame, or ``None`` where the actor does not exist."""
        at = np.flatnonzero(self.frames == frame)
        return self.chunk_SE3_box[at[0]] if len(at) else None


@dataclass(frozen=True)
class SceneGraph:
    """All Gaussians in one batch, each belonging to one node.

    ``nodes`` [N] int64: ``STATIC``, ``DISTANT`` or ``FIRST_ACTOR + k``. Static and distant Gaussians are in chunk
    coordinates, an actor's in its box frame.
    """

    gaussians: Gaussians
    nodes: Tensor  # [N] int64
    actors: tuple[ActorNode, ...]

    def __len__(self) -> int:
        return len(self.gaussians)

    def with_gaussians(self, gaussians: Gaussians) -> SceneGraph:
        """The same graph with other Gaussians (same N and order)."""
        return replace(self, gaussians=gaussians)

    def at(self, frame: int) -> Gaussians:
        """All Gaussians in chunk coordinates at a log frame, N kept and order kept, differentiable.

        Gaussians of an actor that does not exist at ``frame`` get a logit opacity of −30: no renderer draws them, and
        no gradient reaches them. Without actors this returns ``gaussians`` itself.
        """
        g = self.gaussians
        if not self.actors:
            return g
        count = FIRST_ACTOR + len(self.actors)
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
        translation = np.zeros((count, 3))
        present = np.ones(count, dtype=bool)
        for k, actor in enumerate(self.actors):
            pose = actor.pose(frame)
            present[FIRST_ACTOR + k] = pose is not None
            if pose is not None:
                rotation[FIRST_ACTOR + k], translation[FIRST_ACTOR + k] = pose[:3, :3], pose[:3, 3]
        turns = torch.as_tensor(rotation).to(g.means)
        moving = torch.nonzero(self.nodes >= FIRST_ACTOR)[:, 0]
        node = self.nodes[moving]
        turn = turns[node]
        quats = matrix_to_quat(turns)[node]
        means = (turn @ g.means[moving, :, None])[..., 0] + torch.as_tensor(translation).to(g.means)[node]
        absent = ~torch.as_tensor(present, device=node.device)[node]
        opacity = torch.where(absent, torch.full_like(g.logit_opacities[moving], -30.0), g.logit_opacities[moving])
        return Gaussians(
            g.means.index_copy(0, moving, means),
            g.log_scales,
            g.quats.index_copy(0, moving, quat_multiply(quats, g.quats[moving])),
            g.logit_opacities.index_copy(0, moving, opacity),
            g.colors,
        )
