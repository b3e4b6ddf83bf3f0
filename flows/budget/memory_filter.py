"""Leaves out the settings of a table that do not fit into memory: a budget must not choose what cannot run."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from flows.budget.cost_table import CostPoint, CostTable
from flows.configuration import apply_settings
from flows.pipeline.definition import PIPELINE, stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.memory_limit import usable_memory_gib
from flows.pipeline.memory_plan import StageMemory, estimate_chunk_size, grow_until, needs_disk, predict_memory
from genre_tasks.config import PipelineConfig
from genre_tasks.logs.log_selection import select_cameras


class _LargestStage(NamedTuple):
    """The stage of a setting that takes most memory, with images on disk."""

    point: CostPoint
    stage: str
    memory: StageMemory

    @property
    def needed_mib(self) -> float:
        """What the setting needs."""
        return self.memory.with_images_on_disk_mib


def keep_points_that_fit(table: CostTable, base: PipelineConfig, log: str) -> CostTable:
    """Leaves out the settings of a table that need more memory than there is.

    Args:
        table: the settings to choose from.
        base: the user's configuration, over which a setting is applied; with the limit on memory.
        log: the log's URI.

    Returns:
        The table with the settings that fit. Where the machine alone is too small for all of them, with those that need
        least: the prediction may be too high.

    Raises:
        ResourceError: the limit that the user sets is too low for all of them.
        InputError: the log cannot be opened.
    """
    largest = [_find_largest_stage(point, base, log) for point in table.points]
    least = min(largest, key=lambda setting: setting.needed_mib)
    # Raises where the user's limit is too low even for this one.
    needs_disk(least.stage, least.memory, base)
    limit_mib = max(1024 * usable_memory_gib(base), least.needed_mib)
    return replace(table, points=tuple(setting.point for setting in largest if setting.needed_mib <= limit_mib))


def _find_largest_stage(point: CostPoint, base: PipelineConfig, log: str) -> _LargestStage:
    config = apply_settings(base, point.changes)
    opened = cached_log(log)
    size = estimate_chunk_size(opened, select_cameras(config.ingest, opened), config)
    included = stages_until(point.end)
    # Scenes on the way are evaluated, too.
    stages = [spec.name for spec in PIPELINE if spec.name.removeprefix("evaluate/") in included]
    # With one thread, as a stage works with fewer threads where memory is short.
    largest = [
        _LargestStage(point, stage, predict_memory(stage, grow_until(stage, size, config), config, threads=1))
        for stage in stages
    ]
    return max(largest, key=lambda stage: stage.needed_mib)
