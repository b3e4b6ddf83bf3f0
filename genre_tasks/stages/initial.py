"""The stage ``initial``: the Gaussians that a reconstruction begins with (paper Sec. III-A)."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

from genre_tasks.checks import check_finite
from genre_tasks.config import InitialConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.initial_gaussians import build_initial_scene
from genre_tasks.scene.reconstruction import Reconstruction

SCENE_FILE_MODULE = "genre_tasks.stages.scene_file"
"""By name: the code of formats is part of the stage only where a file is read, as the keys of artifacts say."""


def initial(
    config: InitialConfig, chunk: Chunk, plan: EffectsPlan = DEFAULT_PLAN, progress: Progress = silent
) -> Reconstruction:
    """Places Gaussians on the chunk's LiDAR points and far away, or takes those of a file.

    Args:
        config: how many, and how large.
        chunk: as ``ingest`` made it.
        plan: of the chunk's effects.
        progress: called before and after.

    Returns:
        The initial scene, without losses.

    Raises:
        InputError: no point is near the path, or the file cannot be read.
        NonFiniteError: an attribute of a Gaussian is not finite.
    """
    progress(0, 1, "initial scene")
    if config.scene is not None:
        scene = import_module(SCENE_FILE_MODULE).load_initial_scene(config, chunk)
        check_finite(scene.gaussians.pack(), "gaussians", "initial", log=chunk.log, chunk=chunk.index)
        progress(1, 1, "initial scene")
        return Reconstruction(scene)
    chunk = apply_plan(chunk, plan)
    # The plan overrides the configuration: where LiDAR reaches everything, a shell has nothing to show.
    if not plan.is_on("distant_region"):
        config = config.model_copy(update={"distant_count": 0})
    scene = build_initial_scene(config, chunk)
    if plan.is_on("anti_aliasing"):
        # A property of the scene, so that every later render of it is made the same way.
        scene = replace(scene, antialiased=True)
    if plan.is_on("nonrigid_actors"):
        # Imported here: a plan that does not turn the effect on does without its module.
        from genre_tasks.effects.nonrigid_actors import add_rest_deformation

        scene = add_rest_deformation(scene, chunk)
    # Found here, with log and chunk at hand, and not as a NaN loss hours later.
    check_finite(scene.gaussians.pack(), "gaussians", "initial", log=chunk.log, chunk=chunk.index)
    progress(1, 1, "initial scene")
    return Reconstruction(scene)
