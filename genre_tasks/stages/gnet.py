"""GNet: a scene from its initial Gaussians in T learned steps against the source views (paper Sec. III-D)."""

from __future__ import annotations

from genre_tasks.config import OptimiserConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.optimise import PER_SCENE_METHODS, optimise
from genre_tasks.stages.planned_losses import drop_unplanned_losses


def gnet(
    config: OptimiserConfig,
    chunk: Chunk,
    initial: Reconstruction,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
) -> Reconstruction:
    """Reconstructs the scene of a chunk from its source views.

    Fixed novel views enter GNet's training only.

    Args:
        config: the stage's section; ``GnetConfig`` where a refinement or a baseline is configured.
        chunk: of the log.
        initial: result of the stage ``initial``.
        plan: of the chunk's effects.
        progress: called after each iteration.

    Returns:
        Reconstruction: the reconstructed scene, and the snapshots on the way.

    Raises:
        InputError: the chunk has no source view, an image is unreadable, or weights are missing or do not fit.
        ConfigError: the plan leaves no term of the loss.
        NonFiniteError: the optimisation has diverged.
    """
    # A scene of another program is enhanced as it is.
    if config.method == "none":
        return Reconstruction(initial.scene)
    start = prepare_start(config, initial.scene, plan)
    config = drop_unplanned_losses(config, plan, chunk)
    return optimise("gnet", config, apply_plan(chunk, plan), start, None, progress)


def prepare_start(config: OptimiserConfig, scene: SceneGraph, plan: EffectsPlan) -> SceneGraph:
    """Adds spherical harmonics where the plan has them; per-scene 3DGS has one colour per Gaussian in any case.

    Args:
        config: the stage's section.
        scene: of the stage ``initial``.
        plan: of the chunk's effects.

    Returns:
        SceneGraph: where the optimisation starts.
    """
    if not plan.is_on("view_dependent_colour") or config.method in PER_SCENE_METHODS:
        return scene
    # A scene without view-dependent colours imports none of their code.
    from genre_tasks.scene.spherical_harmonics import with_zero_spherical_harmonics

    return with_zero_spherical_harmonics(scene)
