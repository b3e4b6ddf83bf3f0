"""The key of a rollout: the digest over everything that its files depend on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flows.simulation.request import SimulationRequest
from flows.simulation.run_scenes import RunScenes
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.behaviours import BEHAVIOURS
from genre_tasks.errors import InputError
from storage.code_digest import code_digest
from storage.keys import digest_file, stage_key

# Raised when the layout of the files changes, which no digest of code notices: writers lie outside of the closure.
_LAYOUT = 1
_MODULE = "genre_tasks.rollout.render_rollout"
_FURTHER_MODULES = (
    "genre_tasks.ego_paths.collisions",
    "genre_tasks.ego_paths.path_marks",
    "genre_tasks.reliability.reliable_range",
)


def compute_rollout_key(
    request: SimulationRequest, scenes: RunScenes, config: PipelineConfig, modules: Sequence[str] = ()
) -> str:
    """Computes the key of a rollout without reading any scene.

    Args:
        request: what to simulate.
        scenes: of the run.
        config: of the simulation.
        modules: further modules whose code decides on the files.

    Returns:
        64 hex digits.

    Raises:
        InputError: a file of the request does not exist, or an artifact of the run is gone.
    """
    import imageio_ffmpeg

    inputs = dict(scenes.payload_digests())
    if request.path_file is not None:
        inputs["path file"] = _digest_file(request.path_file)
    configuration = {
        "simulate": config.simulate.model_dump(mode="json"),
        "request": request.key_values(),
        "layout": _LAYOUT,
        # The encoder's version decides on the bytes of films.
        "ffmpeg": imageio_ffmpeg.__version__,
    }
    # Behaviours are named by strings, which a reader of imports does not see.
    planners = [behaviour.target.partition(":")[0] for behaviour in BEHAVIOURS.values()]
    code = code_digest(_MODULE, (*_FURTHER_MODULES, "genre_tasks.ego_paths.behaviours", *planners, *modules))
    return stage_key("rollout", code, configuration, inputs)


def _digest_file(path: Path) -> str:
    if not path.is_file():
        raise InputError("there is no such file", remedy="Check the path.", file=path)
    return digest_file(path)
