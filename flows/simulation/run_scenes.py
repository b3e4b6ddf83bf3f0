"""The scenes of a finished run, read from the store when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from flows.pipeline.log_cache import cached_log
from flows.reconstruction.run_records import find_run_record, name_run_folder
from flows.reconstruction.stored_values import find_last_stage, read_stage_scene, read_stage_value
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.errors import InputError
from genre_tasks.logs.types import DrivingLog
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.chunk_scene import CHUNKS_IN_MEMORY, ChunkScene
from storage.opening import open_store

_SAME_POSE = 1e-3


class RunScenes:
    """The chunks of a run with their scenes; a ``SceneSource``.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        chunks: numbers of the chunks to take; ``None``: all.
        chunks_in_memory: how many chunks stay in memory.

    Raises:
        InputError: there is no such run or chunk.
    """

    def __init__(
        self,
        store: str,
        run: str,
        stage: str | None = None,
        chunks: Sequence[int] | None = None,
        *,
        chunks_in_memory: int = CHUNKS_IN_MEMORY,
    ) -> None:
        self.record = find_run_record(store, run)
        available = sorted(entry["chunk"] for entry in self.record["chunks"])
        unknown = sorted(set(chunks or ()) - set(available))
        if unknown:
            raise InputError(f"the run has no chunk {unknown[0]}", remedy=f"It has {available}.")
        self._numbers = [number for number in available if chunks is None or number in chunks]
        self._store = store
        self._stage = stage
        self._read = lru_cache(chunks_in_memory)(self._read_chunk_scene)
        self._digests: dict[str, str] | None = None

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks, in the order of the log."""
        return self._numbers

    @cached_property
    def log(self) -> DrivingLog:
        """The log that the run was made of, for what its scenes do not hold.

        Raises:
            InputError: the log is gone, or another one is in its place.
            ArtifactCorruptError: an artifact is damaged.
        """
        log = cached_log(self.record["log"])
        if not _is_log_of(log, self.load(self._numbers[0]).chunk):
            remedy = "Put the run's log back, or run the one that is there now."
            raise InputError("another log is where the run's was", remedy=remedy, log=log.uri)
        return log

    @property
    def folder(self) -> Path:
        """The run's folder on this machine."""
        return open_store(self._store).records.pull(name_run_folder(str(self.record["run"])))

    def push_folder(self) -> None:
        """Makes what was written into :attr:`folder` visible to everyone who uses the store."""
        open_store(self._store).records.push(name_run_folder(str(self.record["run"])))

    def find_stage(self, number: int) -> str:
        """Finds the stage whose scene is read.

        Args:
            number: of the chunk.

        Returns:
            initial, gnet or enet.
        """
        return self._stage or find_last_stage(self._store, self.record["run"], number)

    def payload_digests(self) -> dict[str, str]:
        """Gives the digests of all that is read, for keys.

        Returns:
            Payload digest by chunk and stage, such as ``chunk 0 ingest``.

        Raises:
            InputError: the run has no such stage, or an artifact is gone.
        """
        if self._digests is None:
            self._digests = self._find_digests()
        return self._digests

    def load(self, number: int) -> ChunkScene:
        """Reads one chunk and its scene; the last few stay in memory.

        Args:
            number: of the chunk.

        Returns:
            The chunk with its plan's effects, and its scene.

        Raises:
            InputError: the run has no such chunk, or an artifact is gone.
            ArtifactCorruptError: an artifact is damaged.
        """
        return self._read(number)

    def _read_chunk_scene(self, number: int) -> ChunkScene:
        run = self.record["run"]
        chunk = read_stage_value(self._store, run, number, "ingest")[1]
        plan = read_stage_value(self._store, run, number, "effects")[1]
        return ChunkScene(apply_plan(chunk, plan), read_stage_scene(self._store, run, number, self.find_stage(number)))

    def _find_digests(self) -> dict[str, str]:
        name_of: dict[str, str] = {}
        for entry in self.record["chunks"]:
            if entry["chunk"] not in self._numbers:
                continue
            keys = {stage["stage"]: stage["key"] for stage in entry["stages"]}
            for stage in ("ingest", "effects", self.find_stage(entry["chunk"])):
                if stage not in keys:
                    raise InputError(
                        f"the run has no stage '{stage}'", remedy=f"It has {', '.join(keys)}.", chunk=entry["chunk"]
                    )
                name_of[keys[stage]] = f"chunk {entry['chunk']} {stage}"
        # One walk through the store for all keys.
        found = {
            name_of[artifact.manifest.key]: artifact.manifest.payload_digest
            for artifact in open_store(self._store).artifacts()
            if artifact.manifest.key in name_of
        }
        missing = sorted(set(name_of.values()) - set(found))
        if missing:
            raise InputError(f"the artifact of {missing[0]} is gone", remedy="Run the log again.", file=self._store)
        return found


def _is_log_of(log: DrivingLog, chunk: Chunk) -> bool:
    frame = chunk.frames[-1]
    if log.name != chunk.log or frame >= log.frame_count:
        return False
    expected = chunk.world_SE3_chunk @ chunk.chunk_SE3_ego[-1]
    return bool(np.allclose(log.world_SE3_lidar(frame), expected, rtol=0, atol=_SAME_POSE))
