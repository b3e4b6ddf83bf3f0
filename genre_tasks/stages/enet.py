"""ENet: the fixer's images distilled back into the scene in T learned steps (paper Sec. III-C)."""

from __future__ import annotations

from genre_tasks.config import OptimiserConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.optimise import optimise
from genre_tasks.stages.planned_losses import drop_unplanned_losses


def enet(
    config: OptimiserConfig,
    chunk: Chunk,
    reconstruction: Reconstruction,
    fixed: FixedViews,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
) -> Reconstruction:
    """Enhances a reconstructed scene with fixed novel views, against the source views as well.

    Args:
        config: the stage's section.
        chunk: of the log.
        reconstruction: result of the stage ``gnet``.
        fixed: result of the stage ``fnet``.
        plan: of the chunk's effects.
        progress: called after each iteration.

    Returns:
        Reconstruction: the enhanced scene, and the snapshots on the way.

    Raises:
        InputError: the chunk has no source view, an image is unreadable, or weights are missing or do not fit.
        ConfigError: the plan leaves no term of the loss.
        NonFiniteError: the optimisation has diverged.
    """
    config = drop_unplanned_losses(config, plan, chunk)
    return optimise("enet", config, apply_plan(chunk, plan), reconstruction.scene, fixed, progress)
