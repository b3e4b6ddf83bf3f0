"""The scenes of a finished run, read from the store when they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

from flows.reconstruction.run_records import find_last_stage, list_runs, read_stage_scene, read_stage_value
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.errors import InputError
from genre_tasks.scene_edits.chunk_scene import ChunkScene

_CHUNKS_IN_MEMORY = 2
"""A rollout needs the scenes on both sides of a border, and no more."""


class RunScenes:
    """The chunks of a run with their scenes; a ``SceneSource``.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        chunks: numbers of the chunks to take; ``None``: all.

    Raises:
        InputError: there is no such run or chunk.
    """

    def __init__(self, store: str, run: str, stage: str | None = None, chunks: Sequence[int] | None = None) -> None:
        found = list_runs(store, run)
        if len(found) != 1 or not run:
            problem = f"{len(found)} runs of this store begin with '{run}'"
            raise InputError(problem, remedy="`genre show runs` lists them.", file=store)
        self.record = found[0]
        available = sorted(entry["chunk"] for entry in self.record["chunks"])
        unknown = sorted(set(chunks or ()) - set(available))
        if unknown:
            raise InputError(f"the run has no chunk {unknown[0]}", remedy=f"It has {available}.")
        self._numbers = [number for number in available if chunks is None or number in chunks]
        self._store = store
        self._stage = stage
        self._loaded: OrderedDict[int, ChunkScene] = OrderedDict()

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks, in the order of the log."""
        return self._numbers

    def load(self, number: int) -> ChunkScene:
        """Reads one chunk and its scene; the last two stay in memory.

        Args:
            number: of the chunk.

        Returns:
            The chunk with its plan's effects, and its scene.

        Raises:
            InputError: the run has no such chunk, or an artifact is gone.
            ArtifactCorruptError: an artifact is damaged.
        """
        if number not in self._loaded:
            run = self.record["run"]
            stage = self._stage or find_last_stage(self._store, run, number)
            chunk = read_stage_value(self._store, run, number, "ingest")[1]
            plan = read_stage_value(self._store, run, number, "effects")[1]
            scene = read_stage_scene(self._store, run, number, stage)
            self._loaded[number] = ChunkScene(apply_plan(chunk, plan), scene)
        self._loaded.move_to_end(number)
        while len(self._loaded) > _CHUNKS_IN_MEMORY:
            self._loaded.popitem(last=False)
        return self._loaded[number]
