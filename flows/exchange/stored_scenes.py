"""Scenes of a store for exporters: those of a finished run, and those that were imported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from flows.exchange.imported_scenes import describe_unknown, find_import, list_imports
from flows.exchange.plan_losses import describe_plan_losses
from flows.reconstruction.run_records import list_runs
from flows.reconstruction.stored_values import read_stage_value
from flows.simulation.edited_runs import open_run
from flows.simulation.run_scenes import RunScenes
from genre_tasks.ego_paths.recorded_path import list_image_times, measure_frame_times
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.conversion import BACKGROUND_NAME, DISTANT_NAME, to_exchange_scene
from genre_tasks.exchange.types import ExchangeScene
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.edits import Insert
from storage.opening import open_store
from storage.store import Artifact

_TIME_DIGITS = 6


class StoredScenes(Protocol):
    """The scenes of one name in a store, chunk by chunk."""

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks."""
        ...

    @property
    def run_scenes(self) -> RunScenes | None:
        """The run, with its chunks; ``None`` for imported scenes, which have no log."""
        ...

    def describe(self) -> dict[str, Any]:
        """Says where the scenes are from, as JSON values."""
        ...

    def describe_chunk(self, number: int) -> dict[str, Any]:
        """Says where a chunk's scene is from: stage, key and digest.

        Args:
            number: of the chunk.
        """
        ...

    def load(self, number: int) -> ExchangeScene:
        """Reads a chunk's scene.

        Args:
            number: of the chunk.

        Raises:
            InputError: the artifact is gone.
            ArtifactCorruptError: it is damaged.
        """
        ...


def open_stored_scenes(
    store: str, name: str, stage: str | None = None, chunks: Sequence[int] | None = None
) -> StoredScenes:
    """Opens scenes by their name; a whole name counts before the start of another one.

    Args:
        store: folder (or URI) of the store.
        name: of a run or an imported scene, the key of an imported scene, or the unique start of one of these.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        chunks: numbers of the chunks to take; ``None``: all.

    Raises:
        InputError: there is no such scene or chunk, several begin with the name, or an import was interrupted.
        ConfigError: a stage is named for an imported scene.
    """
    imports = list_imports(store)
    is_import = any(entry.name == name for entry in imports)
    # Every name begins with an empty text, and so does that of every run.
    runs = list_runs(store, name) if name and not is_import else []
    if any(run["run"] == name for run in runs):
        return _RunStoredScenes(store, name, stage, chunks)
    imported = find_import(imports, name, store)
    if imported is None:
        if imports and not runs:
            raise describe_unknown(imports, name, store)
        return _RunStoredScenes(store, name, stage, chunks)
    if runs:
        raise InputError(f"a run and an imported scene begin with '{name}'", remedy="Give more of it.", file=store)
    if stage is not None:
        raise ConfigError("an imported scene has no stages", remedy="Leave out --stage.")
    return _ImportedScenes(store, imported.artifacts, chunks)


class _RunStoredScenes:
    """The scenes of a finished run; an edited run has its edited scenes."""

    def __init__(self, store: str, name: str, stage: str | None, chunks: Sequence[int] | None) -> None:
        self._store = store
        self.run_scenes = RunScenes(store, name, stage, chunks)
        self._run = str(self.run_scenes.record["run"])

    @property
    def chunk_numbers(self) -> Sequence[int]:
        return self.run_scenes.chunk_numbers

    def describe(self) -> dict[str, Any]:
        record = self.run_scenes.record
        return {"run": self._run, "log": record["log"], "preset": record["preset"]}

    def describe_chunk(self, number: int) -> dict[str, Any]:
        stage = self.run_scenes.find_stage(number)
        entry = next(chunk for chunk in self.run_scenes.record["chunks"] if chunk["chunk"] == number)
        digest = self.run_scenes.payload_digests()[f"chunk {number} {stage}"]
        key = next(found["key"] for found in entry["stages"] if found["stage"] == stage)
        return {"stage": stage, "key": key, "payload_digest": digest}

    def load(self, number: int) -> ExchangeScene:
        chunk_scene = self.run_scenes.load(number)
        chunk = chunk_scene.chunk
        plan = read_stage_value(self._store, self._run, number, "effects")[1]
        # Clocks of logs round their times, and a scene of ten frames a second is to have ten.
        steps_s = np.diff(measure_frame_times(chunk.frames, list_image_times(chunk)), prepend=0.0).round(_TIME_DIGITS)
        return to_exchange_scene(
            chunk_scene.scene,
            chunk.frames,
            np.cumsum(steps_s).round(_TIME_DIGITS).tolist(),
            chunk.world_SE3_chunk,
            names=self._name_tracks(actor.track_id for actor in chunk_scene.scene.actors),
            losses=describe_plan_losses(plan),
        )

    def _name_tracks(self, track_ids: Iterable[str]) -> dict[str, str]:
        # The track of an inserted actor is called as the actor is.
        return {track_id: self._names.get(track_id, track_id) for track_id in track_ids}

    @cached_property
    def _names(self) -> dict[str, str]:
        # Of all chunks, also those that are not exported: the names are those of `genre show actors`.
        opened = open_run(self._store, self._run)
        names = name_actors(opened.recorded)
        inserted = {edit.name for edit in opened.edits.edits if isinstance(edit, Insert) and edit.name}
        taken = {BACKGROUND_NAME, DISTANT_NAME, *names.values(), *inserted}
        # Runs that were edited before these two names were reserved.
        for name in sorted(inserted & {BACKGROUND_NAME, DISTANT_NAME}):
            distinct = name
            while distinct in taken:
                distinct += "-moving"
            names[name] = distinct
        return names


class _ImportedScenes:
    """Scenes that came from files; what a scene graph does not hold is in their manifests."""

    run_scenes = None

    def __init__(self, store: str, artifacts: Mapping[int, Artifact], chunks: Sequence[int] | None) -> None:
        self._store = open_store(store)
        unknown = sorted(set(chunks or ()) - set(artifacts))
        if unknown:
            raise InputError(f"the scene has no chunk {unknown[0]}", remedy=f"It has {sorted(artifacts)}.")
        self._artifacts = {
            number: artifact for number, artifact in artifacts.items() if chunks is None or number in chunks
        }

    @property
    def chunk_numbers(self) -> Sequence[int]:
        return list(self._artifacts)

    def describe(self) -> dict[str, Any]:
        first = next(iter(self._artifacts.values())).manifest
        return {"imported": first.log, "file": first.configuration.get("file", "")}

    def describe_chunk(self, number: int) -> dict[str, Any]:
        manifest = self._artifacts[number].manifest
        return {"stage": manifest.stage, "key": manifest.key, "payload_digest": manifest.payload_digest}

    def load(self, number: int) -> ExchangeScene:
        artifact = self._artifacts[number]
        facts = artifact.manifest.configuration
        return to_exchange_scene(
            self._store.read(artifact).scene,
            facts["frames"],
            facts["times_s"],
            np.array(facts["world_SE3_scene"], np.float64),
            names=facts["names"],
            losses=facts["losses"],
        )
