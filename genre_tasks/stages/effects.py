"""The stage ``effects``: decides once which effects of the forward model a chunk calls for; later stages read it."""

from __future__ import annotations

from genre_tasks.config import EffectsConfig
from genre_tasks.effects.plan import plan_effects
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.logs.types import DrivingLog
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk


def effects(config: EffectsConfig, chunk: Chunk, log: DrivingLog, progress: Progress = silent) -> EffectsPlan:
    """Makes the plan of a chunk's effects.

    Args:
        config: on, off or auto for each effect.
        chunk: as ``ingest`` made it.
        log: that the chunk is of; its cameras state readout and exposure times.
        progress: called with the number of effects done, their total and the name of the next one.

    Returns:
        A decision on each effect with its reason, and the parameters of those that are on.

    Raises:
        ConfigError: an effect is set on that the log makes impossible.
    """
    # The log is read for its cameras alone: what a camera states of its shutter is not part of a chunk.
    return plan_effects(config, chunk, log.cameras, progress)
