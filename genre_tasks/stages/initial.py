"""The initial scene of a chunk (paper Sec. III-A)."""

from __future__ import annotations

from dataclasses import replace

from genre_tasks.config import InitialConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.errors import NonFiniteError
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.initial_gaussians import initial_scene
from genre_tasks.scene.reconstruction import Reconstruction


def initial(
    config: InitialConfig, chunk: Chunk, plan: EffectsPlan = UNPLANNED, progress: Progress = silent
) -> Reconstruction:
    """Gaussians on the chunk's LiDAR points and far away. Raises ``InputError`` if no point is near the path."""
    progress(0, 1, "initial scene")
    chunk = applied(chunk, plan)
    if not plan.on("distant_region"):
        config = config.model_copy(update={"distant_count": 0})
    scene = initial_scene(config, chunk)
    if plan.on("anti_aliasing"):
        scene = replace(scene, antialiased=True)
    if plan.on("nonrigid_actors"):
        from genre_tasks.effects.nonrigid_actors import rigid_at_first

        scene = rigid_at_first(scene, chunk)
    packed = scene.gaussians.packed()
    bad = (~packed.isfinite()).nonzero()
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise NonFiniteError("initial", "gaussians", len(bad), index, log=chunk.log, chunk=chunk.index)
    progress(1, 1, "initial scene")
    return Reconstruction(scene)
