"""The key of a rollout: the digest over everything that its files depend on."""

from __future__ import annotations

from pathlib import Path

from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from flows.simulation.edited_runs import OpenedRun, digest_edits
from flows.simulation.request import SimulationRequest
from flows.simulation.run_scenes import RunScenes
from flows.simulation.sensors import MODULES as SENSOR_MODULES
from flows.simulation.stored_ranges import MARKS_CONFIG
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.behaviours import BEHAVIOURS
from genre_tasks.errors import InputError
from storage.code_digest import code_digest
from storage.keys import digest_file, stage_key

# Raised when the layout of the files changes, which no digest of code notices: writers lie outside of the closure.
_LAYOUT = 2
_MODULES = (
    "genre_tasks.ego_paths.behaviours",
    "genre_tasks.ego_paths.collisions",
    "genre_tasks.ego_paths.path_marks",
    "genre_tasks.ego_paths.recorded_path",
    "genre_tasks.ego_paths.relative_path",
    "genre_tasks.reliability.reliable_range",
)


def compute_rollout_key(request: SimulationRequest, run: OpenedRun, config: PipelineConfig) -> str:
    """Computes the key of a rollout without reading any scene.

    Args:
        request: what to simulate.
        run: the recorded run, and the edits that it has already.
        config: of the simulation.

    Returns:
        64 hex digits.

    Raises:
        InputError: a file of the request does not exist, or an artifact of the run is gone.
    """
    import imageio_ffmpeg

    inputs = dict(run.recorded.payload_digests())
    edits = run.edits + request.edits
    modules = list(_MODULES)
    weights = None
    for sensor in request.sensors:
        modules += SENSOR_MODULES[sensor]
    # Parked vehicles are known from the log alone, and which rays a sensor sends is read from its sweeps. Where it is
    # gone, a path is not checked against them.
    inputs["log"] = _digest_log(run.recorded)
    if len(edits):
        inputs["edits"] = digest_edits(request.store, _open_all_chunks(request, run), edits, config.simulate)
    configuration = {
        "simulate": config.simulate.model_dump(mode="json"),
        "request": request.key_values(),
        "fnet": config.fnet.model_dump(mode="json"),
        "marks": MARKS_CONFIG.model_dump(mode="json"),
        "layout": _LAYOUT,
        # The encoder's version decides on the bytes of films.
        "ffmpeg": imageio_ffmpeg.__version__,
    }
    if request.fix or len(edits):
        # FNet fills what removed actors hid, so edits may need it as well.
        modules.append("genre_tasks.rollout.fix_rollout")
        weights = digest_stage_weights(STAGE_BY_NAME["fnet"], config)
        # Of the LiDAR maps that FNet sees.
        configuration["lidar_max_points"] = config.novel_views.lidar_max_points
    if request.path_file is not None:
        inputs["path file"] = _digest_file(request.path_file)
    # Behaviours are named by strings, which a reader of imports does not see.
    planners = [behaviour.target.partition(":")[0] for behaviour in BEHAVIOURS.values()]
    code = code_digest("genre_tasks.rollout.render_rollout", (*modules, *planners))
    return stage_key("rollout", code, configuration, inputs, weights)


def _digest_log(recorded: RunScenes) -> str:
    try:
        return recorded.log.digest()
    except InputError:
        return "gone"


def _open_all_chunks(request: SimulationRequest, run: OpenedRun) -> RunScenes:
    """All chunks of the recorded run: edits depend on those too that are not shown."""
    if request.chunks is None:
        return run.recorded
    return RunScenes(request.store, run.recorded.record["run"], request.stage)


def _digest_file(path: Path) -> str:
    if not path.is_file():
        raise InputError("there is no such file", remedy="Check the path.", file=path)
    return digest_file(path)
