"""What every method is given: one chunk's initial scene, its source views, and views held out to judge by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from benchmarks.bench import NotMeasuredError
from benchmarks.main_job import reconstruct
from flows.configuration import load_configuration
from flows.produce import ArtifactRef, Job
from flows.train.optimiser import psnr
from flows.train.scenes import spread
from genre_tasks.optimiser.targets import Target, of_source, of_views
from genre_tasks.scene.graph import SceneGraph
from storage.local import open_store

HELDOUT_VIEWS = 12
"""So many held-out views judge, spread evenly: a curve has some twenty points."""


@dataclass(frozen=True)
class Task:
    """A scene in memory, with its targets decoded: the clock starts here.

    ``source``: with LiDAR depth, which per-scene 3DGS does not look at.
    """

    scene: SceneGraph
    source: tuple[Target, ...]
    heldout: tuple[Target, ...]

    def psnr(self, scene: SceneGraph) -> float:
        """Mean over the held-out views, dB."""
        return psnr(scene, self.heldout)


@lru_cache(maxsize=1)
def task_of(log: str, chunk: int, store: str) -> Task:
    """The preset ``small`` up to the initial scene, from and into a store. Raises ``NotMeasuredError`` without data."""
    reader, _, path = log.partition(":")
    if reader == "pandaset" and not Path(path).is_dir():
        raise NotMeasuredError(f"there is no folder {path}; give it with --set pandaset=PATH")
    job = Job(log, chunk, store, load_configuration("small").model_dump(mode="json"))
    refs = reconstruct(job, ("ingest", "initial"))
    read, initial = _value(job, refs["ingest"]), _value(job, refs["initial"])
    heldout = of_views(read, spread(read.of_role("heldout"), HELDOUT_VIEWS))
    return Task(initial.scene, of_source(read, depth=True), heldout)


def _value(job: Job, ref: ArtifactRef):  # type: ignore[no-untyped-def]  # of the artifact's kind
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=ref.key, chunk=job.chunk)
    return store.read(artifact)
