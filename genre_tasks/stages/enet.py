"""ENet: the fixer's images distilled back into the scene in T learned steps (paper Sec. III-C)."""

from __future__ import annotations

from genre_tasks.config import OptimiserConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.optimise import optimise, planned


def enet(
    config: OptimiserConfig,
    chunk: Chunk,
    reconstruction: Reconstruction,
    fixed: FixedViews,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
) -> Reconstruction:
    """The enhanced scene, optimised against source views and fixed novel views.

    Raises ``InputError`` (no source view, an unreadable image, weights that do not fit), ``NonFiniteError``.
    """
    return optimise("enet", planned(config, plan), applied(chunk, plan), reconstruction.scene, fixed, progress)
