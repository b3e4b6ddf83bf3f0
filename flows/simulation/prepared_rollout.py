"""All that a rollout is rendered from: scenes, cameras, a checked path, hand-overs and reliable ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flows.simulation.chunk_outlines import load_outlines
from flows.simulation.edited_runs import OpenedRun, open_edited_scenes
from flows.simulation.parked_actors import list_parked, warn_of_standing_actors
from flows.simulation.request import SimulationRequest
from flows.simulation.rollout_path import CheckedPath, check_path, make_path
from flows.simulation.run_scenes import RunScenes
from flows.simulation.stored_ranges import SideRange, find_side_ranges
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.recorded_path import DEFAULT_FRAME_S, join_recorded_path
from genre_tasks.ego_paths.world_actors import list_world_actors
from genre_tasks.errors import InputError
from genre_tasks.logs.vehicle_center import find_center_ahead
from genre_tasks.progress import Progress
from genre_tasks.rollout.handover import Handover, plan_handovers
from genre_tasks.rollout.rig import RigCamera, estimate_rig
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.suggestions import did_you_mean


@dataclass(frozen=True)
class PreparedRollout:
    """What is rendered, complete and checked.

    Attributes:
        source: the scenes, with edited traffic.
        recorded: the scenes as they were reconstructed.
        rig: the cameras.
        checked: the path.
        handovers: between chunks.
        ranges: of each chunk's scene, by number; empty where no marks are asked for.
        pose_s: seconds from one pose to the next.
        edit_warnings: what edits do not change.
    """

    source: SceneSource
    recorded: RunScenes
    rig: Sequence[RigCamera]
    checked: CheckedPath
    handovers: tuple[Handover, ...]
    ranges: dict[int, SideRange]
    pose_s: float
    edit_warnings: tuple[str, ...] = ()


def prepare_rollout(
    request: SimulationRequest, run: OpenedRun, config: PipelineConfig, progress: Progress
) -> PreparedRollout:
    """Plans and checks the path of a rollout, and looks where its scenes can be trusted.

    Args:
        request: what to simulate.
        run: the recorded run, and the edits that it has already.
        config: of the simulation.
        progress: called while scenes are measured.

    Returns:
        All that rendering needs.

    Raises:
        InputError: there is no such camera, or a file is unfit.
        ConfigError: the path is implausible or meets an actor.
    """
    source = _edit_traffic(request, run, config)
    chunks = load_outlines(source)
    recorded_chunks = load_outlines(run.recorded) if isinstance(source, EditedScenes) else chunks
    rig = select_cameras(estimate_rig(chunks), request.cameras)
    recorded = join_recorded_path(chunks)
    path = make_path(request, config.simulate, recorded)
    actors = (*list_world_actors(chunks), *list_parked(run.recorded, recorded_chunks))
    center_ahead_m = find_center_ahead(str(run.recorded.record["log"]), config.simulate.center_ahead_m)
    checked = check_path(request, config.simulate, path, recorded, actors, center_ahead_m=center_ahead_m)
    # After the checks, which end most of the requests that are no good, and take no time.
    ranges = find_side_ranges(run.recorded, progress) if request.mark_range else {}
    progress(0, len(path), "hand-over")
    handovers = plan_handovers(source, path, rig, config.simulate.handover_frames)
    steps = np.diff(path.times_s)
    pose_s = float(np.median(steps)) if len(steps) else DEFAULT_FRAME_S
    names = source.changed_names if isinstance(source, EditedScenes) else {}
    standing = warn_of_standing_actors(run.recorded, recorded_chunks, names)
    edit_warnings = tuple(warning for warnings in standing.values() for warning in warnings)
    return PreparedRollout(source, run.recorded, rig, checked, handovers, ranges, pose_s, edit_warnings)


def _edit_traffic(request: SimulationRequest, run: OpenedRun, config: PipelineConfig) -> SceneSource:
    if not len(run.edits + request.edits):
        return run.recorded
    return open_edited_scenes(
        request.store, request.run, request.edits, config.simulate, stage=request.stage, chunks=request.chunks
    )


def select_cameras(rig: Sequence[RigCamera], names: Sequence[str] | None) -> tuple[RigCamera, ...]:
    """Takes some cameras of a rig.

    Args:
        rig: of a log.
        names: of the cameras; ``None``: all.

    Returns:
        The cameras in the order of the rig.

    Raises:
        InputError: the rig has no such camera.
    """
    known = [camera.name for camera in rig]
    for name in names or ():
        if name not in known:
            remedy = f"{did_you_mean(name, known)}It has {', '.join(known)}."
            raise InputError(f"the log has no camera '{name}'", remedy=remedy)
    return tuple(camera for camera in rig if names is None or camera.name in names)
