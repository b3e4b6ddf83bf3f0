"""A chunk with the scene that was reconstructed from it: what edits change, and what rollouts render."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph

CHUNKS_IN_MEMORY = 2
"""Chunks that a source of scenes keeps: a rollout needs those on both sides of a border, and no more."""


@dataclass(frozen=True)
class ChunkScene:
    """A chunk and its scene.

    Attributes:
        chunk: with its plan's effects applied; ``chunk.actors`` are in step with ``scene.actors``.
        scene: Gaussians in the chunk's coordinates.
        removed: recorded actors that an edit took away or moved: what they hid calls for filling.
    """

    chunk: Chunk
    scene: SceneGraph
    removed: tuple[ActorNode, ...] = ()


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
