"""Runs with edited traffic: opened for a rollout, or written into the store as runs of their own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flows.machine.facts import describe_environment
from flows.machine.resource_usage import measure_usage
from flows.pipeline.stage_runner import ArtifactRef
from flows.reconstruction.run_records import (
    FinishedRun,
    find_run_record,
    summarise_run,
    write_run_record,
)
from flows.reconstruction.stored_values import find_last_stage, read_stage_value
from flows.simulation.parked_actors import warn_of_standing_actors
from flows.simulation.recorded_settings import read_recorded_edits, read_simulate_config
from flows.simulation.run_scenes import RunScenes
from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.errors import InputError
from genre_tasks.exchange.conversion import BACKGROUND_NAME, DISTANT_NAME
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.scene_edits.actor_library import ActorLibrary
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.scene_edits.edits import Edit, EditList, Insert
from genre_tasks.scene_edits.stored_chunk import prepare_stored_chunk
from storage.address import Address
from storage.code_digest import code_digest
from storage.opening import open_store
from storage.store import Artifact, Provenance

_EDITS_MODULE = "genre_tasks.scene_edits.edited_scenes"
_STORED_CHUNK_MODULE = "genre_tasks.scene_edits.stored_chunk"


@dataclass(frozen=True)
class OpenedRun:
    """A run whose scenes can be edited.

    Attributes:
        recorded: its scenes as they were reconstructed, before any edit.
        edits: those that the run was made with, if it is an edited one.
    """

    recorded: RunScenes
    edits: EditList


def open_run(store: str, run: str, stage: str | None = None, chunks: Sequence[int] | None = None) -> OpenedRun:
    """Opens a run; behind an edited run is the recorded one with the edits.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        stage: initial, gnet or enet; ``None``: the last one.
        chunks: numbers of the chunks to take; ``None``: all.

    Returns:
        The recorded run and the edits so far.

    Raises:
        InputError: there is no such run or chunk, or another version wrote edits that this one cannot read.
    """
    scenes = RunScenes(store, run, stage, chunks)
    edited = scenes.record.get("edited")
    if edited is None:
        return OpenedRun(scenes, EditList())
    return OpenedRun(RunScenes(store, edited["run"], stage, chunks), read_recorded_edits(scenes.record))


def open_edited_scenes(
    store: str,
    run: str,
    edits: EditList,
    config: SimulateConfig,
    *,
    stage: str | None = None,
    chunks: Sequence[int] | None = None,
) -> EditedScenes:
    """Opens the scenes of a run with edits, those of an edited run and new ones together.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        edits: new ones; may be empty.
        config: darkness of contact shadows.
        stage: initial, gnet or enet; ``None``: the last one.
        chunks: numbers of the chunks to take; ``None``: all.

    Returns:
        The edited scenes, whose chunks say which actors are removed or moved.

    Raises:
        InputError: there is no such run, chunk or actor, or a new actor has the name of a part of every scene.
    """
    # Surveyed as a whole, whichever chunks are shown: names, tracks and the ground are those of the run.
    opened = open_run(store, run, stage)
    _require_free_names(edits, before=len(opened.edits))
    shown = None if chunks is None else RunScenes(store, run, stage, chunks).chunk_numbers
    library = ActorLibrary(lambda name: open_shown_scenes(store, name))
    return EditedScenes(opened.recorded, opened.edits + edits, library, config, shown)


def _require_free_names(edits: EditList, before: int) -> None:
    """Refuses new actors with names of parts; stored edits may have them, from before these names were reserved."""
    for number, edit in enumerate(edits.edits, start=before + 1):
        if isinstance(edit, Insert) and edit.name in (BACKGROUND_NAME, DISTANT_NAME):
            raise InputError(
                f"edit {number} ({edit.kind}): every scene has a part that is called '{edit.name}'",
                remedy="Give the inserted actor another name.",
            )


def open_shown_scenes(store: str, run: str) -> RunScenes | EditedScenes:
    """Opens the scenes of a run as it is: of an edited run the edited ones.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.

    Raises:
        ConfigError: another version wrote the record, with settings of simulations that this one does not know.
        InputError: there is no such run.
    """
    opened = open_run(store, run)
    if not len(opened.edits):
        return opened.recorded
    config = read_simulate_config(opened.recorded.record)
    return open_edited_scenes(store, run, EditList(), config)


def digest_edits(store: str, recorded: RunScenes, edits: EditList, config: SimulateConfig) -> str:
    """Computes what edits add to the key of all that is made with them.

    Args:
        store: folder (or URI) of the store.
        recorded: all chunks of the run, as they were reconstructed.
        edits: the list.
        config: of re-simulation.

    Returns:
        64 hex digits over the edits, all scenes of the run and of those that actors are taken from, the settings and
        the code.

    Raises:
        InputError: a run that an actor is from does not exist, or an artifact of the run is gone.
    """
    runs = sorted({edit.from_run for edit in edits.edits if isinstance(edit, Insert) and edit.from_run is not None})
    values = {
        "edits": edits.model_dump(mode="json"),
        # A chunk depends on the others: they decide on names, tracks and the ground, and lend it actors.
        "inputs": recorded.payload_digests(),
        "runs": {name: RunScenes(store, name).record["run"] for name in runs},
        "contact_shadow": config.contact_shadow,
        "code": code_digest(_EDITS_MODULE, (_STORED_CHUNK_MODULE,)),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def write_edited_run(store: str, run: str, edits: EditList, config: SimulateConfig | None = None) -> dict[str, Any]:
    """Writes the edited scenes of a run into the store, as a run that other commands know by its name.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        edits: of its traffic.
        config: of re-simulation; ``None``: the run's.

    Returns:
        The new run's record, with ``edited``: the recorded run, all edits, and warnings of what they leave as it was.
        It lacks the chunks that the recorded run lacks, and has its budget.

    Raises:
        InputError: there is no such run or actor, or an artifact is gone.
        GenreError: the store cannot be written.
    """
    opened = open_run(store, run)
    record = opened.recorded.record
    settings = read_simulate_config(record) if config is None else config
    scenes = open_edited_scenes(store, run, edits, settings)
    # The start of a name may be that of several runs one day.
    named = EditList(edits=tuple(_name_source_run(store, edit) for edit in scenes.edits.edits))
    digest = digest_edits(store, opened.recorded, named, settings)
    chunks = {
        number: _write_chunk(store, record["run"], number, scenes, named, digest) for number in scenes.chunk_numbers
    }
    recorded_chunks = (opened.recorded.load(number).chunk for number in scenes.chunk_numbers)
    standing = warn_of_standing_actors(opened.recorded, recorded_chunks, scenes.changed_names)
    note = f"the traffic of run {record['run']} is edited"
    finished = FinishedRun(
        log=record["log"],
        preset=record["preset"],
        store=store,
        config=record["config"],
        differs={key: (before, after) for key, (before, after) in record["differs"].items()},
        chunks=chunks,
        notes={number: "; ".join((note, *standing.get(number, ()))) for number in chunks},
        # Edits bring no chunk back that could not be reconstructed.
        left_out=record.get("left_out", ()),
    )
    # The scenes are those that the budget's choices made, whatever was asked for.
    extra = {"budget": record["budget"]} if "budget" in record else {}
    warnings = [warning for found in standing.values() for warning in found]
    extra["edited"] = {"run": record["run"], "edits": named.model_dump(mode="json"), "warnings": warnings}
    return write_run_record(finished, summarise_run(finished), extra)


def _name_source_run(store: str, edit: Edit) -> Edit:
    """The edit with the full name of the run that an actor is from."""
    if not isinstance(edit, Insert) or edit.from_run is None:
        return edit
    return edit.model_copy(update={"from_run": find_run_record(store, edit.from_run)["run"]})


def _write_chunk(
    store: str, run: str, number: int, scenes: EditedScenes, edits: EditList, digest: str
) -> dict[str, ArtifactRef]:
    stage = find_last_stage(store, run, number)
    keys = _stage_keys(store, run, number)
    with measure_usage() as usage:
        edited = scenes.load(number)
    ingested = read_stage_value(store, run, number, "ingest")[1]
    recorded_plan = read_stage_value(store, run, number, "effects")[1]
    chunk, plan = prepare_stored_chunk(ingested, recorded_plan, edited.chunk.actors)
    values: dict[str, tuple[str, Any]] = {
        "ingest": ("chunk", chunk),
        stage: ("reconstruction", Reconstruction(edited.scene)),
    }
    opened = open_store(store)
    refs: dict[str, ArtifactRef] = {}
    if plan is recorded_plan:
        refs["effects"] = _reference(next(iter(opened.artifacts(key=keys["effects"]))))
    else:
        values["effects"] = ("effects", plan)
    for name, (kind, value) in values.items():
        key = hashlib.sha256(f"{keys[name]}\n{digest}".encode()).hexdigest()
        address = Address(ingested.dataset, ingested.log, number, name, key)
        provenance = Provenance(
            inputs={name: keys[name]},
            configuration=edits.model_dump(mode="json"),
            code_digest=code_digest(_EDITS_MODULE, (_STORED_CHUNK_MODULE,)),
            seconds=usage.seconds,
            peak_mib=usage.peak_mib,
            environment=describe_environment(),
        )
        refs[name] = _reference(opened.commit(address, kind, value, provenance))
    return refs


def _stage_keys(store: str, run: str, number: int) -> dict[str, str]:
    record = RunScenes(store, run).record
    stages = next(chunk["stages"] for chunk in record["chunks"] if chunk["chunk"] == number)
    return {stage["stage"]: stage["key"] for stage in stages}


def _reference(artifact: Artifact) -> ArtifactRef:
    manifest = artifact.manifest
    return ArtifactRef(manifest.stage, manifest.key, manifest.payload_digest, artifact.address, cached=False)
