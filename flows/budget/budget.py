"""The budget of a whole run: one deadline and one table, and a chooser for each chunk."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from flows.budget.chooser import Chooser, count_images
from flows.budget.cost_table import CostTable, find_shipped_table, load_cost_table
from flows.budget.deadline import Deadline
from flows.budget.memory_filter import keep_points_that_fit
from flows.configuration import apply_settings, diff_from_preset
from flows.configuration.absolute_paths import make_paths_absolute
from flows.configuration.settings import keys_overlap
from flows.machine.calibration import measure_calibration_s
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError

_KEYS_OF_TIME = frozenset(
    {
        "ingest.source_every",
        "gnet.method",
        "gnet.views_per_iteration",
        "enet.views_per_iteration",
        "enet.novel_views_per_iteration",
        "novel_views.every",
        "novel_views.shifts_m",
        "fnet.model",
        "fnet.max_network_px",
    }
)
"""Settings by which stages take several times as long, so that a table without them predicts nothing."""


def resolve_table(table: str | None, preset: str, config: PipelineConfig) -> CostTable:
    """Loads the table that a run within a budget chooses from, and checks it against the user's settings.

    Args:
        table: the cost.parquet of a sweep; ``None`` for the table that ships with the preset.
        preset: the preset of the run.
        config: the run's configuration; a key that differs from the preset counts as set by the user.

    Returns:
        The table.

    Raises:
        ConfigError: the table was measured with settings that the run does not have, or without some that change what
            its stages take, or as
            :func:`flows.budget.cost_table.load_cost_table` and ``find_shipped_table`` raise it.
    """
    path = Path(table) if table else find_shipped_table(preset)
    own_keys = diff_from_preset(config, preset)
    loaded = load_cost_table(path, preset, own_keys)
    # A table may name a file by a path that is relative to this folder; a run's paths are absolute.
    absolute = make_paths_absolute(config)
    required = {setting: apply_settings(config, [setting]) for setting in loaded.settings}
    if lacking := [setting for setting, other in required.items() if make_paths_absolute(other) != absolute]:
        raise ConfigError(
            f"this table was measured with {', '.join(lacking)}, which this run does not have",
            remedy="Give the run the same with --set, or a table that was measured without.",
            file=path,
        )
    measured_keys = [setting.partition("=")[0] for setting in loaded.settings]
    own_keys_of_time = sorted(_KEYS_OF_TIME.intersection(own_keys))
    if unknown := [key for key in own_keys_of_time if not any(keys_overlap(key, other) for other in measured_keys)]:
        raise ConfigError(
            f"this table was measured without {', '.join(unknown)}, which changes what stages take",
            remedy=f"Give the cost.parquet of `genre cost LOG --preset {preset} --set …` with --table.",
            file=path,
        )
    return loaded


class Budget:
    """Shares the time of a run among its chunks and chooses the settings that fit. Evaluation does not count.

    Args:
        budget_s: seconds that the run may take.
        start_time: when the run began, in seconds since the epoch; ``None`` for now.
        table: the cost.parquet of a sweep; ``None`` for the table that ships with the preset.
        preset: the preset of the run.
        config: the run's configuration, over which settings of the table are applied.

    Attributes:
        deadline: counts the time of the run.
        speed: this machine's calibration over the table's; ``None`` until it is measured.
        choosers: the chooser of each chunk that was begun, by chunk.

    Raises:
        ConfigError: the budget is no time, or as :func:`resolve_table` raises it.
    """

    def __init__(
        self, budget_s: float, start_time: float | None, table: str | None, preset: str, config: PipelineConfig
    ) -> None:
        # A flow's parameters may be anything, and NaN would compare as enough time for every setting.
        if isinstance(budget_s, bool) or not isinstance(budget_s, int | float) or not 0 < budget_s < math.inf:
            raise ConfigError(f"the budget is no time above 0: {budget_s!r}", remedy="Give seconds, such as 90.")
        self.deadline = Deadline(budget_s, start_time)
        self._table = resolve_table(table, preset, config)
        self._config = config
        self.speed: float | None = None
        self.choosers: dict[int, Chooser] = {}
        self._fitting_tables: dict[str, CostTable] = {}

    def make_chooser(self, log: str, chunk: int) -> Chooser:
        """Makes the chooser of a chunk and keeps it for the record.

        Args:
            log: the log's URI.
            chunk: number of the chunk.

        Returns:
            The chooser, which asks for this machine's speed when it needs it.

        Raises:
            ResourceError: no setting of the table fits into the memory that the user allows.
        """
        fitting = self.keep_what_fits(log)
        chooser = Chooser(
            fitting,
            self._config,
            self.deadline,
            image_factor=count_images(log, chunk, self._config) / self._table.images,
            measure_speed=self.measure_speed,
            # The first stage of a kind in a process loads code and weights.
            warm_stages={stage for earlier in self.choosers.values() for stage in earlier.computed_stages},
            left_out=len(self._table.points) - len(fitting.points),
        )
        # The first chunk has to wait with this; later ones know it from the start.
        if self.speed is not None:
            chooser.calibrate()
        self.choosers[chunk] = chooser
        return chooser

    def keep_what_fits(self, log: str) -> CostTable:
        """Leaves out the settings that memory is too small for.

        Args:
            log: the log's URI.

        Returns:
            The table with the settings that fit; found once for a log, as it takes from the budget.

        Raises:
            ResourceError: no setting of the table fits into the memory that the user allows.
        """
        if log not in self._fitting_tables:
            self._fitting_tables[log] = keep_points_that_fit(self._table, self._config, log)
        return self._fitting_tables[log]

    def measure_speed(self) -> float:
        """Measures this machine's speed once; later calls give the same number.

        Returns:
            Seconds of the calibration here over those of the table's machine: more than 1 where this one is slower.
        """
        # Measured once for the whole run: it takes a second, and other work beside it would disturb it.
        if self.speed is None:
            self.speed = measure_calibration_s() / self._table.calibration_s
        return self.speed

    def describe(self) -> str:
        """Says in one line how much time there is and where the table was measured.

        Returns:
            A line for the user, before the first choice.
        """
        return (
            f"budget {self.deadline.budget_s:g} s, {self.deadline.used_s:.1f} s used so far; "
            f"its settings were measured on {self._table.machine}"
        )

    def as_record(self) -> dict[str, Any]:
        """Gathers what the run's record keeps of the budget, once the last scene is there.

        Returns:
            ``budget_s``, ``used_s``, ``speed`` (``None`` where nothing was computed), and the choices of each chunk.
        """
        chunks = [{"chunk": chunk, **chooser.as_record()} for chunk, chooser in self.choosers.items()]
        # Time after the last chunk's last stage is evaluation and the report, which do not count.
        used_s = max((chooser.used_s for chooser in self.choosers.values()), default=self.deadline.used_s)
        return {"budget_s": self.deadline.budget_s, "used_s": used_s, "speed": self.speed, "chunks": chunks}
