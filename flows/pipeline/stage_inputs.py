"""Reads the inputs of a stage, once it is known whether the images of many views fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from flows.machine.memory_reuse import return_freed_memory, reuse_freed_memory
from flows.pipeline.definition import StageSpec
from flows.pipeline.log_cache import cached_log
from flows.pipeline.memory_plan import (
    StageMemory,
    choose_threads,
    estimate_chunk_size,
    keeps_freed_memory,
    measure_chunk_size,
    needs_disk,
    predict_memory,
)
from flows.pipeline.scene_size import count_start_gaussians
from genre_tasks.config import PipelineConfig
from storage.store import Artifact, Store

_IMAGE_STAGES = ("novel_views", "fnet")
"""Stages whose artifacts are the images of many views."""


@dataclass(frozen=True)
class StageInputs:
    """What a stage computes from, and what it was predicted to take.

    Attributes:
        values: by the name of the stage that made them.
        memory: of the stage that will work on them.
        images_on_disk: whether the images of many views lie on disk; freed memory is then returned at once.
    """

    values: dict[str, Any]
    memory: StageMemory
    images_on_disk: bool

    @property
    def predicted_mib(self) -> float:
        """Memory that the stage will take, MiB."""
        return self.memory.with_images_on_disk_mib if self.images_on_disk else self.memory.in_memory_mib


@contextmanager
def open_inputs(
    spec: StageSpec, log: str, config: PipelineConfig, store: Store, artifacts: Mapping[str, Artifact], is_retry: bool
) -> Iterator[StageInputs]:
    """Reads a stage's inputs, and has the process use memory as the prediction says while the block runs.

    Args:
        spec: the stage.
        log: the log's URI.
        config: the effective configuration, with the limit.
        store: that the artifacts are in.
        artifacts: of the stage's inputs.
        is_retry: whether memory ran out before: images then lie on disk, whatever the prediction.

    Yields:
        The inputs.

    Raises:
        ResourceError: the limit is too low for the stage.
        ArtifactCorruptError: an artifact is damaged.
    """
    # These take little memory, and their sizes tell how much the others take.
    values = {name: store.read(artifacts[name]) for name in spec.inputs if name not in _IMAGE_STAGES}
    if not spec.name.startswith("evaluate/"):
        # Only an evaluation looks at the scenes on the way, which together are larger than the last one.
        values = {name: _drop_snapshots(value) for name, value in values.items()}
    memory, threads = _predict(spec, log, config, values)
    on_disk = needs_disk(spec.name, memory, config) or is_retry
    # With freed memory that stays, images on disk alone save too little.
    if keeps_freed_memory(config) and not on_disk:
        reuse_freed_memory()
    else:
        return_freed_memory()
    # Here and not above: it imports torch, which commands that only read records would wait seconds for.
    from genre_tasks.image_memory import hold_images_on_disk
    from genre_tasks.threads import torch_threads

    with torch_threads(threads), hold_images_on_disk(store.scratch_folder if on_disk else None):
        values |= {name: store.read(artifacts[name]) for name in spec.inputs if name in _IMAGE_STAGES}
        yield StageInputs(values, memory, on_disk)


def _drop_snapshots(value: Any) -> Any:
    return replace(value, snapshots={}) if hasattr(value, "snapshots") else value


def _predict(spec: StageSpec, log: str, config: PipelineConfig, values: Mapping[str, Any]) -> tuple[StageMemory, int]:
    """The stage's memory, and the threads with which it takes no more."""
    import torch

    # ``ingest`` itself has no chunk yet, but the log says how large one will be.
    if "ingest" not in values:
        from genre_tasks.logs.log_selection import select_cameras

        opened = cached_log(log)
        size = estimate_chunk_size(opened, select_cameras(config.ingest, opened), config)
    else:
        # The scene that the stage starts from; before there is one, its file or the configuration says how large it is.
        scenes = [len(value.scene) for value in values.values() if hasattr(value, "scene")]
        start = count_start_gaussians(config.initial)
        size = measure_chunk_size(values["ingest"], config, max(scenes, default=start))
    threads = choose_threads(spec.name, size, config, torch.get_num_threads())
    return predict_memory(spec.name, size, config, threads), threads
