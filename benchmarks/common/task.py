"""What every optimiser starts from: one chunk's initial scene, its source views, and views to evaluate it by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from urllib.parse import unquote

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.novel_view_truth import load_true_targets
from benchmarks.common.run_stages import reconstruct
from flows.configuration import load_configuration
from flows.pipeline.stage_runner import Job, read_artifact
from flows.training.optimiser_training import mean_psnr
from flows.training.training_scenes import evenly_spaced
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_EFFECTS, DEFAULT_PLAN, EffectsPlan
from genre_tasks.losses.targets import Target, source_targets, view_targets
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.stages.gnet import prepare_start
from genre_tasks.user_paths import expand_user_path

HELDOUT_VIEWS = 12
"""Number of held-out views that a scene is evaluated by, spread evenly: a curve has some twenty points."""
WITHOUT_EFFECTS = ("effects=none", *(f"effects.{name}=on" for name in sorted(DEFAULT_EFFECTS)))
"""Optimisers are compared on what all of them model; ``genre bench effects`` measures the rest."""
_READERS_OF_PARTS = ("nuscenes", "waymo")
SIDE_M = 3.0
"""Metres beside the path at which curves are evaluated: where the fixer works."""


@dataclass(frozen=True)
class OptimisationTask:
    """A scene in memory, with its targets decoded: the clock starts here.

    Attributes:
        scene: the initial scene.
        source: targets of the source views, with LiDAR depth, which per-scene 3DGS does not use.
        heldout: targets of held-out views, which no method sees.
        novel_targets: ray-cast at ±3 m; none on a real log.
        plan: of the effects that scene and targets have.
    """

    scene: SceneGraph
    source: tuple[Target, ...]
    heldout: tuple[Target, ...]
    novel_targets: tuple[Target, ...] = ()
    plan: EffectsPlan = DEFAULT_PLAN

    def psnr(self, scene: SceneGraph) -> float:
        """Averages a scene's PSNR over the held-out views, dB."""
        return mean_psnr(scene, self.heldout)

    def psnr_novel(self, scene: SceneGraph) -> float | None:
        """Averages a scene's PSNR over the views at ±3 m, dB; ``None`` where there is no truth."""
        return mean_psnr(scene, self.novel_targets) if self.novel_targets else None


# One task only: the decoded targets of a chunk take most of the memory.
@lru_cache(maxsize=1)
def load_task(log: str, chunk: int, store: str, *settings: str) -> OptimisationTask:
    """Runs the preset ``small`` up to the initial scene; the last task stays in memory.

    Args:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store that stages come from and go to.
        settings: ``section.key=value`` over the preset.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    job = make_job(log, chunk, store, None, *settings)
    refs = reconstruct(job, ("ingest", "effects", "initial"))
    ingested = read_artifact(job, refs["ingest"])
    return OptimisationTask(
        scene=read_artifact(job, refs["initial"]).scene,
        source=source_targets(ingested, depth=True),
        heldout=view_targets(ingested, evenly_spaced(ingested.views_with_role("heldout"), HELDOUT_VIEWS)),
        novel_targets=load_true_targets(log, store, ingested, SIDE_M),
    )


def load_planned_task(job: Job) -> OptimisationTask:
    """Runs a job up to the initial scene, with the effects that its plan calls for, as a run has them.

    Args:
        job: of a log without a truth beside its path.

    Returns:
        The scene with its targets, at their refined poses and exposures.
    """
    refs = reconstruct(job, ("ingest", "effects", "initial"))
    plan = read_artifact(job, refs["effects"])
    chunk = apply_plan(read_artifact(job, refs["ingest"]), plan)
    gnet = PipelineConfig.model_validate(job.config).gnet
    return OptimisationTask(
        scene=prepare_start(gnet, read_artifact(job, refs["initial"]).scene, plan),
        source=source_targets(chunk, depth=True),
        heldout=view_targets(chunk, evenly_spaced(chunk.views_with_role("heldout"), HELDOUT_VIEWS)),
        plan=plan,
    )


def make_job(log: str, chunk: int, store: str, order: int | None = None, *settings: str) -> Job:
    """Builds a job of the preset ``small``, with the effects alone that all optimisers model.

    Args:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store.
        order: seed of GNet's and ENet's order of views; with it they keep no snapshots, which would cost time.
        settings: ``section.key=value`` over the preset.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    require_log_folder(log)
    # Snapshots cost time and are not read here, so an order leaves them out.
    seeds = [] if order is None else [f"{s}.{k}" for s in ("gnet", "enet") for k in (f"seed={order}", "snapshots=0")]
    config = load_configuration("small", settings=[*WITHOUT_EFFECTS, *seeds, *settings])
    return Job(log, chunk, store, config.model_dump(mode="json"))


def require_log_folder(log: str) -> None:
    """Checks that the folder of a real log is there.

    Args:
        log: URI of a log; a synthetic one needs no folder.

    Raises:
        NotMeasuredError: it is not.

    >>> require_log_folder("synthetic:street?seed=1001")
    >>> require_log_folder("pandaset:nowhere/002")
    Traceback (most recent call last):
    benchmarks.common.bench.NotMeasuredError: there is no folder nowhere/002; name it in the option of the log
    """
    # A missing download is no failure of the code, so the cell says why it was not measured.
    if not has_log_folder(log):
        raise NotMeasuredError(f"there is no folder {_log_path(log)}; name it in the option of the log")


def has_log_folder(log: str) -> bool:
    """Says whether the files of a log are there.

    Args:
        log: URI of a log; a synthetic one needs none.

    >>> has_log_folder("kitti:nowhere/drive?labels=labels.txt")
    False
    """
    if log.startswith("synthetic:"):
        return True
    path = expand_user_path(_log_path(log))
    # The last part of these names a scene or a segment, and is no file.
    return path.parent.is_dir() if log.partition(":")[0] in _READERS_OF_PARTS else path.exists()


def _log_path(log: str) -> str:
    # Options stand behind the question mark, as those of KITTI do; a path writes special characters with %.
    return unquote(log.partition(":")[2].partition("?")[0])
