"""The scenes of stages that a table or a benchmark has run, chunk after chunk of one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.chunk_scene import CHUNKS_IN_MEMORY, ChunkScene


class StageScenes:
    """The chunks of a log with the scenes of one method; a ``SceneSource``.

    Args:
        jobs: one for each chunk, in the order of the log.
        refs: the artifacts of each job by stage: ``ingest``, ``effects`` and ``end`` are read.
        end: the stage whose scene is rendered: initial, gnet or enet.
    """

    def __init__(self, jobs: Sequence[Job], refs: Sequence[Mapping[str, ArtifactRef]], end: str) -> None:
        self._parts = {job.chunk: (job, artifacts) for job, artifacts in zip(jobs, refs, strict=True)}
        self._end = end
        self._read = lru_cache(CHUNKS_IN_MEMORY)(self._read_chunk_scene)

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks, in the order of the log."""
        return tuple(self._parts)

    def load(self, number: int) -> ChunkScene:
        """Reads one chunk and its scene; the last two stay in memory.

        Args:
            number: of the chunk.

        Returns:
            The chunk with its plan's effects, and its scene.

        Raises:
            ArtifactCorruptError: an artifact is gone or damaged.
        """
        return self._read(number)

    def read_chunk(self, number: int, planned: bool = True) -> Chunk:
        """Reads one chunk without its scene.

        Args:
            number: of the chunk.
            planned: whether its plan's effects are applied.

        Raises:
            ArtifactCorruptError: an artifact is gone or damaged.
        """
        job, artifacts = self._parts[number]
        chunk: Chunk = read_artifact(job, artifacts["ingest"])
        return apply_plan(chunk, read_artifact(job, artifacts["effects"])) if planned else chunk

    def _read_chunk_scene(self, number: int) -> ChunkScene:
        job, artifacts = self._parts[number]
        return ChunkScene(self.read_chunk(number), read_artifact(job, artifacts[self._end]).scene)
