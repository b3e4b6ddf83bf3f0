"""What every method is given: one chunk's initial scene, its source views, and views to judge by that none sees."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.novel_view_truth import true_targets
from benchmarks.common.run_stages import reconstruct
from flows.configuration import load_configuration
from flows.pipeline.stage_runner import Job, value_of
from flows.training.optimiser_training import psnr
from flows.training.training_scenes import spread
from genre_tasks.effects.types import BASIC
from genre_tasks.losses.targets import Target, of_source, of_views
from genre_tasks.scene.graph import SceneGraph

HELDOUT_VIEWS = 12
"""So many held-out views judge, spread evenly: a curve has some twenty points."""
WITHOUT_EFFECTS = ("effects=none", *(f"effects.{name}=on" for name in sorted(BASIC)))
"""Optimisers are compared on what all of them model; ``genre bench effects`` measures the rest."""
SIDE_M = 3.0
"""Where curves are judged beside the path: where the fixer works."""


@dataclass(frozen=True)
class Task:
    """A scene in memory, with its targets decoded: the clock starts here.

    ``source``: with LiDAR depth, which per-scene 3DGS does not look at. ``beside``: ray-cast at ±3 m; none on a real
    log.
    """

    scene: SceneGraph
    source: tuple[Target, ...]
    heldout: tuple[Target, ...]
    beside: tuple[Target, ...] = ()

    def psnr(self, scene: SceneGraph) -> float:
        """Mean over the held-out views, dB."""
        return psnr(scene, self.heldout)

    def psnr_beside(self, scene: SceneGraph) -> float | None:
        """Mean over the views at ±3 m, dB; ``None`` where there is no truth."""
        return psnr(scene, self.beside) if self.beside else None


@lru_cache(maxsize=1)
def task_of(log: str, chunk: int, store: str, *settings: str) -> Task:
    """The preset ``small`` up to the initial scene, from and into a store; ``settings`` as for ``genre run --set``.

    Raises ``NotMeasuredError`` without data.
    """
    job = job_of(log, chunk, store, None, *settings)
    refs = reconstruct(job, ("ingest", "effects", "initial"))
    read, initial = value_of(job, refs["ingest"]), value_of(job, refs["initial"])
    heldout = of_views(read, spread(read.of_role("heldout"), HELDOUT_VIEWS))
    beside = true_targets(log, store, read, SIDE_M)
    return Task(initial.scene, of_source(read, depth=True), heldout, beside)


def job_of(log: str, chunk: int, store: str, order: int | None = None, *settings: str) -> Job:
    """The preset ``small``, with ``order`` as the seed of GNet's and ENet's views and then without snapshots.

    Raises ``NotMeasuredError`` where the log's folder is missing.
    """
    reader, _, path = log.partition(":")
    if reader == "pandaset" and not Path(path).is_dir():
        raise NotMeasuredError(f"there is no folder {path}; give it with --set pandaset=PATH")
    seeds = [] if order is None else [f"{s}.{k}" for s in ("gnet", "enet") for k in (f"seed={order}", "snapshots=0")]
    return Job(
        log,
        chunk,
        store,
        load_configuration("small", settings=[*WITHOUT_EFFECTS, *seeds, *settings]).model_dump(mode="json"),
    )
