"""The budget of a whole run: one clock and one table, a chooser for each chunk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flows.budget.chooser import Chooser, images_of
from flows.budget.cost_table import Table, load, shipped_table
from flows.budget.deadline import Clock
from flows.configuration import differences
from flows.machine.calibration import calibration_s
from genre_tasks.config import PipelineConfig


def table_for(table: str | None, preset: str, config: PipelineConfig) -> Table:
    """What a run with ``config`` over ``preset`` chooses from: the file ``table``, or the preset's own.

    Raises ``ConfigError`` as ``measured.load`` does.
    """
    return load(Path(table) if table else shipped_table(preset), preset, differences(config, preset))


class Budget:
    """``budget_s`` seconds from ``began`` (since the epoch; now without it) for a run with ``config`` over ``preset``.

    ``table`` is the cost.parquet of a sweep; the preset's own without it. Evaluation is not counted.
    """

    def __init__(
        self, budget_s: float, began: float | None, table: str | None, preset: str, config: PipelineConfig
    ) -> None:
        self.clock = Clock(budget_s, began)
        self._table, self._config = table_for(table, preset, config), config
        self.speed: float | None = None
        self.choosers: dict[int, Chooser] = {}

    def chooser(self, log: str, chunk: int) -> Chooser:
        """Of a chunk; the first one's stages are also the first of the process."""
        work = images_of(log, chunk, self._config) / self._table.images
        made = Chooser(self._table, self._config, self.clock, work, self.calibrated, not self.choosers)
        self.choosers[chunk] = made
        return made

    def calibrated(self) -> float:
        """This machine's calibration over the table's, measured once: more than 1 where it is slower."""
        if self.speed is None:
            self.speed = calibration_s() / self._table.calibration_s
        return self.speed

    def told(self) -> str:
        """What the clock says before the first choice."""
        return (
            f"budget {self.clock.budget_s:g} s, {self.clock.used_s:.1f} s used so far; "
            f"its settings were measured on {self._table.machine}"
        )

    def record(self) -> dict[str, Any]:
        """For the run's record, once the last scene is there. ``speed`` is null where nothing was computed."""
        chunks = [{"chunk": c, **by.record()} for c, by in self.choosers.items()]
        used_s = max((by.used_s for by in self.choosers.values()), default=self.clock.used_s)
        return {"budget_s": self.clock.budget_s, "used_s": used_s, "speed": self.speed, "chunks": chunks}
