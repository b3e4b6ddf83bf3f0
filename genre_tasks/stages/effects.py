"""Effects: what of the forward model a chunk calls for, decided once and read by every later stage."""

from __future__ import annotations

from genre_tasks.config import EffectsConfig
from genre_tasks.effects.plan import plan
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.logs.types import DrivingLog
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk


def effects(config: EffectsConfig, chunk: Chunk, log: DrivingLog, progress: Progress = silent) -> EffectsPlan:
    """The chunk's plan. Raises ``ConfigError`` for an effect set on that the log makes impossible."""
    return plan(config, chunk, log.cameras, progress)
