"""Values that a finished run has left in the store: chunks, plans and scenes, by the run's name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flows.reconstruction.run_records import find_run_record
from genre_tasks.errors import InputError
from storage.opening import open_store

if TYPE_CHECKING:
    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.graph import SceneGraph

SCENE_STAGES = ("initial", "gnet", "enet")
"""The stages that make a scene, in their order."""


def read_stage_value(store: str, run: str, chunk: int | None, stage: str) -> tuple[int, Any]:
    """Reads the value of a stage of a finished run.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        chunk: number of the chunk; ``None`` for the run's first one.
        stage: the stage's name.

    Returns:
        The number of the chunk, and the stage's value.

    Raises:
        InputError: there is no such run, chunk or stage, or the artifact is gone.
        ArtifactCorruptError: the artifact is damaged.
    """
    record = find_run_record(store, run)
    stages_by_chunk = {c["chunk"]: c["stages"] for c in record["chunks"]}
    number = min(stages_by_chunk) if chunk is None else chunk
    if number not in stages_by_chunk:
        raise InputError(
            f"the run has no chunk {number}", remedy=f"It has {sorted(stages_by_chunk)}.", log=record["log"]
        )
    keys = {s["stage"]: s["key"] for s in stages_by_chunk[number]}
    if stage not in keys:
        raise InputError(f"the run has no stage '{stage}'", remedy=f"It has {', '.join(keys)}.", stage=stage)
    opened = open_store(store)
    # A key is unique, so the first artifact is the one.
    for artifact in opened.artifacts(key=keys[stage]):
        return number, opened.read(artifact)
    raise InputError("the artifact is gone", remedy="Run the log again.", log=record["log"], stage=stage)


def read_stage_scene(store: str, run: str, chunk: int, stage: str) -> SceneGraph:
    """Reads the scene that a stage of a finished run has made.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        chunk: number of the chunk.
        stage: initial, gnet or enet.

    Returns:
        The scene.

    Raises:
        InputError: the stage makes no scene, or as :func:`read_stage_value` raises it.
        ArtifactCorruptError: the artifact is damaged.
    """
    if stage not in SCENE_STAGES:
        raise InputError(
            f"the stage {stage} makes no scene", remedy=f"Those do: {', '.join(SCENE_STAGES)}.", stage=stage
        )
    scene: SceneGraph = read_stage_value(store, run, chunk, stage)[1].scene
    return scene


def find_last_stage(store: str, run: str, chunk: int) -> str:
    """Finds the stage whose scene is the result of a run's chunk.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        chunk: number of the chunk.

    Returns:
        ``enet``, or an earlier stage where a budget ended the run before it.

    Raises:
        InputError: there is no such run.
    """
    record = find_run_record(store, run)
    stages = {s["stage"] for c in record["chunks"] if c["chunk"] == chunk for s in c["stages"]}
    # A budget may have ended the run with an earlier scene.
    return next(name for name in reversed(SCENE_STAGES) if name in stages)


def read_next_scene(store: str, run: str, chunk: int, stage: str | None) -> tuple[Chunk, SceneGraph] | None:
    """Reads the chunk that follows another one, and its scene.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        chunk: number of the chunk before.
        stage: the stage whose scene is read; ``None`` for the last one of that chunk.

    Returns:
        The next chunk with its plan of effects and its scene, or ``None`` if the run does not have that chunk.

    Raises:
        InputError: as :func:`read_stage_value` raises it.
        ArtifactCorruptError: an artifact is damaged.
    """
    # Imported here: commands that read one value need not load the plan's code.
    from genre_tasks.effects.apply_plan import apply_plan

    following = chunk + 1
    if following not in {c["chunk"] for c in find_run_record(store, run)["chunks"]}:
        return None
    name = stage or find_last_stage(store, run, following)
    _, ingested = read_stage_value(store, run, following, "ingest")
    planned = apply_plan(ingested, read_stage_value(store, run, following, "effects")[1])
    return planned, read_stage_scene(store, run, following, name)
