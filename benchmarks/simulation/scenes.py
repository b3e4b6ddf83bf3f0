"""The scenes that re-simulation is measured on: those of the paper's methods on all chunks of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row, split_option
from benchmarks.common.run_stages import print_progress
from benchmarks.common.task import require_log_folder
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.layouts import SIMULATION_PROTOCOL
from flows.paper_tables.rollouts import PlannedRollout, TableRollout, plan_rollout
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.simulation.stage_scenes import StageScenes
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import join_recorded_path
from genre_tasks.ego_paths.world_actors import list_parked_actors, list_world_actors
from genre_tasks.logs.synthetic.edited_truth import TruthView
from genre_tasks.logs.synthetic.log import SyntheticStreet
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.logs.vehicle_center import find_center_ahead
from genre_tasks.rollout.rig import RigCamera, RolloutView, estimate_rig
from genre_tasks.rollout.rollout_scores import use_global_shutter
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.actor_library import ActorLibrary
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.scene_edits.edits import Edit, EditList

METHOD = "genre+"
"""What everything but the comparison of methods is measured with."""
TRAINING_CHUNK = 0
"""Of the real sequence: networks were trained, and settings tuned, on it (docs/guides/training.md)."""


@dataclass(frozen=True)
class SimulationCase:
    """A log whose scenes are measured.

    Attributes:
        log: its URI.
        chunks: numbers of the chunks that rollouts go through.
        store: folder of the store.
        settings: ``section.key=value`` over preset and protocol.
    """

    log: str
    chunks: tuple[int, ...]
    store: str
    settings: tuple[str, ...]

    @property
    def is_real(self) -> bool:
        """Whether the log was recorded, and so has no truth beside its path."""
        return cached_log(self.log).truth is None

    def jobs(self, method: str = METHOD) -> list[Job]:
        """Builds the jobs of a method, one for each chunk.

        Args:
            method: a key of ``BUILT_IN``.
        """
        config = BUILT_IN[method].configuration("small", (*SIMULATION_PROTOCOL, *self.settings)).model_dump(mode="json")
        return [Job(self.log, chunk, self.store, config) for chunk in self.chunks]


class LogScenes:
    """The scenes of one log as a rollout needs them.

    Args:
        case: the log; stages that the store lacks are computed.

    Attributes:
        source: the scenes of all chunks.
        config: of the method.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """

    def __init__(self, case: SimulationCase) -> None:
        require_log_folder(case.log)
        jobs = case.jobs()
        end = BUILT_IN[METHOD].end
        refs = [_run_quietly(job, end) for job in jobs]
        self.case = case
        self.source = StageScenes(jobs, refs, end)
        self.config = PipelineConfig.model_validate(jobs[0].config)

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The chunks with their plans' effects."""
        return [self.source.read_chunk(number) for number in self.source.chunk_numbers]

    @property
    def recorded(self) -> EgoPath:
        """The recorded path of the ego vehicle."""
        return join_recorded_path(self.chunks)

    @property
    def rig(self) -> tuple[RigCamera, ...]:
        """The cameras, with a global shutter as the truth has it."""
        return use_global_shutter(estimate_rig(self.chunks))

    @cached_property
    def names(self) -> dict[str, str]:
        """What edits call the actors, by track id; a street's track ids look alike and mean others."""
        return name_actors(self.source)

    def plan(self, rollout: TableRollout) -> PlannedRollout:
        """Plans a rollout as table 6 does, see :func:`flows.paper_tables.rollouts.plan_rollout`.

        Args:
            rollout: what to drive.

        Raises:
            ConfigError: the log has no room for it.
        """
        config = self.config.simulate
        center_ahead_m = find_center_ahead(self.case.log, config.center_ahead_m)
        parked = list_parked_actors(cached_log(self.case.log).tracks(), self.chunks)
        actors = (*list_world_actors(self.chunks), *parked)
        return plan_rollout(rollout, self.recorded, config, actors, center_ahead_m=center_ahead_m)

    @property
    def street(self) -> SyntheticStreet:
        """The log, where it is a synthetic one.

        Raises:
            NotMeasuredError: it was recorded.
        """
        log = cached_log(self.case.log)
        if not isinstance(log, SyntheticStreet):
            raise NotMeasuredError("only synthetic streets have a truth of edits")
        return log


@lru_cache(maxsize=1)
def open_scenes(case: SimulationCase) -> LogScenes:
    """Opens the scenes of a log; those of the last log stay open.

    Args:
        case: the log.
    """
    return LogScenes(case)


def _run_quietly(job: Job, end: str) -> Mapping[str, ArtifactRef]:
    refs: dict[str, ArtifactRef] = {}
    for stage in stages_until(end):
        refs[stage] = run_stage(stage, job, refs)
        if not refs[stage].cached:
            print_progress(f"{job.log} chunk {job.chunk} {stage}: done")
    return refs


def cases_from_options(options: Mapping[str, str], settings: tuple[str, ...]) -> list[SimulationCase]:
    """Lists the logs that the options name, streets first.

    Args:
        options: ``seeds``, ``pandaset``, ``chunks`` and ``store``.
        settings: over preset and protocol.

    Returns:
        One case for each street and one for the real sequence, all chunks in it.
    """
    logs = [f"synthetic:street?seed={seed}" for seed in split_option(options["seeds"])]
    if options["pandaset"]:
        logs.append(f"pandaset:{options['pandaset']}")
    chunks = tuple(int(number) for number in split_option(options["chunks"]))
    return [SimulationCase(log, chunks, options["store"], settings) for log in logs]


def truth_view(chunk: Chunk, frame: float, chunk_SE3_camera: Float64, lens: Lens) -> TruthView:
    """Takes a view of a chunk to the world, where the truth is.

    Args:
        chunk: in whose coordinates the view is.
        frame: log frame, or a moment between two.
        chunk_SE3_camera: [4, 4].
        lens: of the view.
    """
    return TruthView(frame, chunk.world_SE3_chunk @ chunk_SE3_camera, lens)


def source_views(chunk: Chunk) -> list[TruthView]:
    """Lists the images that a chunk's scene was fitted to."""
    views = chunk.views_with_role("source")
    return [truth_view(chunk, v.frame, v.chunk_SE3_camera, v.lens) for v in views]


def recorded_views(chunk: Chunk, rig: Sequence[RigCamera]) -> list[RolloutView]:
    """Lists the views of all cameras along the recorded path of a chunk.

    Args:
        chunk: in whose coordinates they are.
        rig: the cameras.
    """
    return [
        RolloutView(camera.name, float(frame), chunk_SE3_ego @ camera.ego_SE3_camera, camera.lens)
        for frame, chunk_SE3_ego in zip(chunk.frames, chunk.chunk_SE3_ego, strict=True)
        for camera in rig
    ]


def edit_scenes(scenes: LogScenes, *edits: Edit) -> EditedScenes:
    """Edits the traffic of a log's scenes.

    Args:
        scenes: of the log.
        edits: in order; none takes an actor from another run.

    Raises:
        InputError: an edit names an actor that does not exist.
    """
    library = ActorLibrary(lambda run: scenes.source)
    return EditedScenes(scenes.source, EditList(edits=edits), library, scenes.config.simulate)


def cut_path(path: EgoPath, first: int, count: int) -> EgoPath:
    """Takes consecutive poses of a path.

    Args:
        path: P poses.
        first: index of the first one.
        count: how many at most.
    """
    rows = slice(first, first + count)
    times = np.asarray(path.times_s[rows])
    return EgoPath(times - times[0], path.frames[rows], path.world_SE3_ego[rows])


def log_label(row: Row) -> str:
    """Names a row's log shortly.

    >>> log_label({"log": "synthetic:street?seed=1001&frames=40"})
    'street 1001'
    >>> log_label({"log": "pandaset:data/002"})
    'pandaset 002'
    """
    kind, _, rest = str(row["log"]).partition(":")
    if kind == "synthetic":
        return "street " + rest.partition("seed=")[2].partition("&")[0]
    return f"{kind} {rest.rpartition('/')[2]}"


def describe_training(rows: Sequence[Row]) -> str:
    """Says that part of a real log is training data, to append to the data of a claim.

    Args:
        rows: with ``log`` and ``chunks``.

    Returns:
        A clause; empty where every log is one that was never trained on.

    >>> describe_training([{"log": "pandaset:data/002", "chunks": [0, 1]}])
    '; chunk 0 of pandaset 002 is training data'
    >>> describe_training([{"log": "synthetic:street?seed=1001", "chunks": [0, 1]}])
    ''
    """
    # Streets have seeds of their own for training, so that every chunk of the others is unseen.
    recorded = [row for row in rows if not str(row["log"]).startswith("synthetic:")]
    trained_on = [log_label(row) for row in recorded if TRAINING_CHUNK in row["chunks"]]
    return f"; chunk {TRAINING_CHUNK} of {', '.join(trained_on)} is training data" if trained_on else ""
