"""A chunk with the scene that was reconstructed from it: what edits change, and what rollouts render."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph

CHUNKS_IN_MEMORY = 2
"""Chunks that a source of scenes keeps: a rollout needs those on both sides of a border, and no more."""


@dataclass(frozen=True)
class ChunkScene:
    """A chunk and its scene.

    Attributes:
        chunk: with its plan's effects applied; ``chunk.actors`` are in step with ``scene.actors``.
        scene: Gaussians in the chunk's coordinates.
        removed: recorded actors that an edit took away or moved: what they hid calls for filling.
        shadow_counts: by track id, how many Gaussians of an actor are its contact shadow: the last ones of its node.
            An actor without a shadow may be missing.
    """

    chunk: Chunk
    scene: SceneGraph
    removed: tuple[ActorNode, ...] = ()
    shadow_counts: Mapping[str, int] = field(default_factory=dict)

    def find_shadows(self) -> Tensor:
        """Finds the Gaussians that are contact shadows: they darken the ground, and are no surface of an actor.

        Returns:
            [N] bool, for the Gaussians of ``scene``.
        """
        is_shadow = torch.zeros_like(self.scene.nodes, dtype=torch.bool)
        for number, actor in enumerate(self.scene.actors, start=FIRST_ACTOR):
            count = self.shadow_counts.get(actor.track_id, 0)
            if count:
                is_shadow[torch.nonzero(self.scene.nodes == number)[-count:, 0]] = True
        return is_shadow


class SceneSource(Protocol):
    """The scenes of a run's chunks, read when they are asked for."""

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks, in the order of the log."""
        ...

    def load(self, number: int) -> ChunkScene:
        """Reads one chunk and its scene; the last few stay in memory.

        Args:
            number: of the chunk.
        """
        ...
