"""Measures rollouts of a method on a log, each from the store where it was measured before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from flows.experiments.stages import StageRunner, run_reported_stage, run_stages
from flows.paper_tables.methods import End
from flows.paper_tables.rollouts import TABLE_ROLLOUTS, PlannedRollout, TableRollout, plan_rollout, take_every
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.progress import get_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job
from flows.simulation.stage_scenes import StageScenes
from flows.training.training_scenes import get_or_make
from genre_tasks.config import EvaluateConfig, PipelineConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import join_recorded_path
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors, list_world_actors
from genre_tasks.errors import InputError
from genre_tasks.logs.types import DrivingLog
from genre_tasks.logs.vehicle_center import find_center_ahead
from genre_tasks.metrics.network_files import NETWORK_ARGUMENTS, find_network_files
from genre_tasks.rollout.handover import plan_handovers
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.rollout.rig import RigCamera, estimate_rig
from genre_tasks.rollout.rollout_scores import (
    RealImages,
    RolloutScores,
    cast_true_images,
    collect_real_images,
    place_true_views,
    score_rollout,
    use_global_shutter,
)
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews
from storage.address import Address
from storage.code_digest import code_digest
from storage.files import digest_file
from storage.keys import digest_bytes, digest_value
from storage.opening import open_store

TRUE_VIEWS = 12
"""Views of a rollout that are ray-cast, half a second each; spread evenly over poses and cameras."""
SCORES = "rollout_scores"
TRUTH = "rollout_truth"
"""Stages of the store where scores and true images of rollouts are."""
_RENDERING = ("genre_tasks.rollout.render_rollout", "genre_tasks.rollout.handover")


@dataclass(frozen=True)
class RolloutRow:
    """A method's rollout on a log, measured.

    Attributes:
        method: label of the method.
        log: URI of the log.
        chunks: numbers of the chunks that were driven through.
        rollout: behaviour and start that were asked for.
        start_offset_m: where it starts, metres to the left of the recorded path.
        strength: of the behaviour, see :func:`flows.paper_tables.rollouts.plan_rollout`.
        poses: number of poses that were rendered.
        metrics: ``psnr``, ``ssim`` and ``perceptual`` over views with a truth, ``kernel``, ``frechet`` and ``fid`` of
            all images; ``NAME/n`` images, and ``NAME/low``, ``NAME/high`` of 95 % intervals.
        collisions: overlaps with actors, a sentence each.
        has_boxes: whether the log's boxes could be read. Without them parked vehicles are not known, and the path was
            not checked against them.
        scores: everything that was measured, for paired comparisons.
    """

    method: str
    log: str
    chunks: tuple[int, ...]
    rollout: TableRollout
    start_offset_m: float
    strength: float
    poses: int
    metrics: Mapping[str, float]
    collisions: tuple[str, ...] = ()
    has_boxes: bool = True
    scores: RolloutScores | None = field(default=None, compare=False, repr=False)


def measure_rollout_scores(
    method: str,
    jobs: Sequence[Job],
    end: End,
    rollouts: Sequence[TableRollout] = TABLE_ROLLOUTS,
    runner: StageRunner = run_reported_stage,
    true_views: int = TRUE_VIEWS,
) -> list[RolloutRow]:
    """Runs the stages of a method on the chunks of a log, and measures rollouts through all of them.

    Every rollout's scores are stored when they are there, so that a stopped measurement goes on.

    Args:
        method: label of the rows.
        jobs: one for each chunk of one log, in order; they differ in nothing but the chunk.
        end: the stage whose scenes are rendered, gnet or enet.
        rollouts: what to drive.
        runner: runs one stage.
        true_views: views of a rollout that are compared with the truth, where the log has one.

    Returns:
        A row for each rollout, in their order.

    Raises:
        ConfigError: the log has no room for a behaviour.
        GenreError: as the stages raise it.
    """
    refs = [run_stages(stages_until(end), job, runner) for job in jobs]
    measurement = LogMeasurement(jobs, refs, end)
    rows = []
    for done, rollout in enumerate(rollouts):
        get_reporter().progress(done, len(rollouts), str(rollout))
        rows.append(measurement.measure(method, rollout, true_views))
    return rows


class LogMeasurement:
    """What the rollouts of one method on one log share: the recorded path, the rig and the scenes.

    Args:
        jobs: one for each chunk of the log, in order.
        refs: the artifacts of each job's stages, by stage.
        end: the stage whose scenes are rendered.

    Attributes:
        scenes: of the method.
        recorded: the recorded path through all chunks.
        rig: the cameras, with a global shutter.

    Raises:
        ArtifactCorruptError: an artifact is gone or damaged.
    """

    def __init__(self, jobs: Sequence[Job], refs: Sequence[Mapping[str, ArtifactRef]], end: End) -> None:
        self._jobs = tuple(jobs)
        self._config = PipelineConfig.model_validate(jobs[0].config)
        self._log = cached_log(jobs[0].log)
        self._store = open_store(jobs[0].store)
        self.scenes = StageScenes(jobs, refs, end)
        chunks = [self.scenes.read_chunk(number) for number in self.scenes.chunk_numbers]
        self.recorded = join_recorded_path(chunks)
        self.rig = use_global_shutter(estimate_rig(chunks))
        self._first = chunks[0]
        parked = _list_parked(self._log, chunks)
        self._has_boxes = parked is not None
        self._actors = (*list_world_actors(chunks), *(parked or ()))
        self._scene_digests = [[found[s].payload_digest for s in ("ingest", "effects", end)] for found in refs]

    def measure(self, method: str, rollout: TableRollout, true_views: int = TRUE_VIEWS) -> RolloutRow:
        """Measures one rollout, or reads what was measured.

        Args:
            method: label of the row.
            rollout: what to drive.
            true_views: views that are compared with the truth, where the log has one.

        Raises:
            ConfigError: the log has no room for the behaviour.
        """
        planned = self.plan(rollout)
        address = self._scores_address(planned, true_views)
        scores = get_or_make(self._store, address, SCORES, lambda: self._score(planned, true_views))
        return RolloutRow(
            method=method,
            log=self._jobs[0].log,
            chunks=tuple(job.chunk for job in self._jobs),
            rollout=rollout,
            start_offset_m=planned.start_offset_m,
            strength=planned.strength,
            poses=len(self._select_poses(planned)),
            metrics=_name_metrics(scores),
            collisions=planned.collisions,
            has_boxes=self._has_boxes,
            scores=scores,
        )

    def plan(self, rollout: TableRollout) -> PlannedRollout:
        """Plans a rollout on this log, see :func:`flows.paper_tables.rollouts.plan_rollout`."""
        config = self._config.simulate
        center_ahead_m = find_center_ahead(self._log.uri, config.center_ahead_m)
        return plan_rollout(rollout, self.recorded, config, self._actors, center_ahead_m=center_ahead_m)

    def is_stored(self, rollout: TableRollout, true_views: int = TRUE_VIEWS) -> bool:
        """Says whether a rollout was measured before.

        Args:
            rollout: what to drive.
            true_views: as for :meth:`measure`.

        Raises:
            ConfigError: the log has no room for the behaviour.
        """
        planned = self.plan(rollout)
        return self._store.find(self._scores_address(planned, true_views)) is not None

    def read_real_images(self) -> RealImages:
        """Gives what rollouts of this log are compared with as a set."""
        chunks = [self.scenes.read_chunk(number, planned=False) for number in self.scenes.chunk_numbers]
        return collect_real_images(chunks, self._config.evaluate)

    def _score(self, planned: PlannedRollout, true_views: int) -> RolloutScores:
        true_images = self._cast_truth(planned, true_views)
        path = self._select_poses(planned)
        # As `genre simulate` hands over from chunk to chunk, measured on all poses.
        handovers = plan_handovers(self.scenes, planned.path, self.rig, self._config.simulate.handover_frames)
        rendered = render_rollout(self.scenes, path, self.rig, handovers=handovers)
        return score_rollout(rendered, self._config.evaluate, self.read_real_images(), true_images)

    def _select_poses(self, planned: PlannedRollout) -> EgoPath:
        # Kernel distances are unbiased at any number of images, so that fewer poses only widen their interval.
        return take_every(planned.path, self._config.evaluate.every)

    def _cast_truth(self, planned: PlannedRollout, count: int) -> FixedViews | None:
        """The true images of some views, from the store where another method asked for them before."""
        truth = self._log.truth
        if truth is None:
            return None
        path = self._select_poses(planned)
        views = place_true_views(path, self.rig, count, planned.start_offset_m)
        images = [[v.camera, v.frame, v.lens.width_px, v.lens.height_px] for v in views]
        reader = code_digest(type(self._log).__module__)
        fields = {"log": self._log.digest(), "code": reader, "views": images, "path": _digest_path(path)}
        key = digest_value(fields | {"rig": _digest_rig(self.rig)})
        return get_or_make(
            self._store, self._address(TRUTH, key), "fixed_views", lambda: cast_true_images(truth, views)
        )

    def _scores_address(self, planned: PlannedRollout, true_views: int) -> Address:
        fields = {
            "code": code_digest("genre_tasks.rollout.rollout_scores", (*_RENDERING, type(self._log).__module__)),
            "scenes": self._scene_digests,
            "path": _digest_path(planned.path),
            "rig": _digest_rig(self.rig),
            "handover_frames": self._config.simulate.handover_frames,
            "evaluate": _describe_evaluation(self._config.evaluate),
            # A log without a truth has the same scores whatever number of true views is asked for.
            "truth": None if self._log.truth is None else [self._log.digest(), true_views],
        }
        return self._address(SCORES, digest_value(fields))

    def _address(self, stage: str, key: str) -> Address:
        return Address(self._log.dataset, self._log.name, self._first.index, stage, key)


def _list_parked(log: DrivingLog, chunks: Sequence[Chunk]) -> tuple[WorldActor, ...] | None:
    """The parked vehicles of a log; ``None`` where its boxes cannot be read, without which its scenes were made too."""
    try:
        tracks = log.tracks()
    except InputError:
        return None
    return list_parked_actors(tracks, chunks)


def _name_metrics(scores: RolloutScores) -> dict[str, float]:
    values: dict[str, float] = {}
    for metric in scores.metrics:
        values[metric.name] = metric.value
        values[f"{metric.name}/n"] = float(metric.n)
        if metric.low is not None and metric.high is not None:
            values[f"{metric.name}/low"] = metric.low
            values[f"{metric.name}/high"] = metric.high
    return values


def _digest_path(path: EgoPath) -> str:
    # By its very numbers: a change of how behaviours are planned counts exactly where it moves a pose.
    return digest_bytes(path.frames.tobytes() + path.world_SE3_ego.tobytes())


def _digest_rig(rig: Sequence[RigCamera]) -> str:
    return digest_value([[c.name, repr(c.lens), digest_bytes(c.ego_SE3_camera.tobytes())] for c in rig])


def _describe_evaluation(config: EvaluateConfig) -> dict[str, object]:
    # Shifts and pictures are of the stage alone, so that they must not change the key of a rollout.
    described: dict[str, object] = {
        "distributions": config.distributions,
        "bootstrap": config.bootstrap,
        "every": config.every,
    }
    files = find_network_files(config)
    for name in NETWORK_ARGUMENTS:
        # A file counts by its bytes, a network of a package by its name.
        described[name] = digest_file(files[name]) if name in files else getattr(config, name)
    return described
