"""GNet: a scene from its initial Gaussians in T learned steps against the source views (paper Sec. III-D)."""

from __future__ import annotations

from genre_tasks.config import OptimiserConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.optimise import PER_SCENE, optimise, planned


def gnet(
    config: OptimiserConfig,
    chunk: Chunk,
    initial: Reconstruction,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
) -> Reconstruction:
    """The reconstructed scene. Source views only: fixed novel views enter GNet's training alone.

    Raises ``InputError`` (no source view, an unreadable image, weights that do not fit), ``NonFiniteError``.
    """
    return optimise(
        "gnet", planned(config, plan), applied(chunk, plan), _start(config, initial.scene, plan), None, progress
    )


def _start(config: OptimiserConfig, scene: SceneGraph, plan: EffectsPlan) -> SceneGraph:
    """With harmonics where the plan has them; per-scene 3DGS has one colour a Gaussian in any case."""
    if not plan.on("view_dependent_colour") or config.method in PER_SCENE:
        return scene
    from genre_tasks.scene.spherical_harmonics import starting

    return starting(scene)
