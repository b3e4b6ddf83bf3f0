"""What a user asks to sweep, checked before anything is computed."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from flows.cost_sweep.cell import Cell, Sweep, list_cells
from flows.cost_sweep.knobs import list_settings
from flows.experiments.log_chunks import select_log_chunks
from flows.pipeline.definition import stages_until
from flows.preflight.requirements import check_jobs

DEFAULT_SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class SweepRequest:
    """What a user asks to sweep.

    Attributes:
        sweep: preset, settings and store.
        logs: URIs; ``pandaset:PATH/*`` stands for every sequence in a folder.
        chunks: of each log; all if ``None``.
        seeds: see :class:`flows.cost_sweep.cell.Cell`; three if ``None``.
        knobs: names of knobs; all if ``None``.
    """

    sweep: Sweep
    logs: Sequence[str]
    chunks: list[int] | None = None
    seeds: Sequence[int] | None = None
    knobs: Sequence[str] | None = None

    def cells(self) -> list[Cell]:
        """Lists the cells in the order in which they run, and checks that their stages can run.

        Raises:
            ConfigError: there is no such knob, or a setting is not allowed.
            InputError: a log does not have one of the chunks, a file is missing, or the store cannot be written to.
        """
        settings = list_settings(self.sweep.preset, self.sweep.settings, self.knobs or ())
        base = settings[0].configuration(self.sweep.preset, self.sweep.settings, 0)
        places = select_log_chunks(self.logs, self.chunks, base)
        cells = list_cells(places, DEFAULT_SEEDS if self.seeds is None else self.seeds, settings)
        # Cells that differ by the seed alone need the same.
        distinct = {(cell.where, cell.setting): cell for cell in cells}.values()
        check_jobs((self.sweep.job(cell), _list_stages(cell)) for cell in distinct)
        return cells

    @property
    def command(self) -> str:
        """The command that sweeps the same cells again.

        >>> SweepRequest(Sweep("demo", (), "store"), ["synthetic:street"], chunks=[2]).command
        'genre cost synthetic:street --preset demo --chunks 2'
        """
        parts = ["genre", "cost", *self.logs, "--preset", self.sweep.preset]
        for option, values in (("--chunks", self.chunks), ("--seeds", self.seeds), ("--knobs", self.knobs)):
            if values:
                parts += [option, ",".join(map(str, values))]
        for setting in self.sweep.settings:
            parts += ["--set", setting]
        return shlex.join(parts)


def _list_stages(cell: Cell) -> tuple[str, ...]:
    return (*stages_until(cell.setting.end), f"evaluate/{cell.setting.end}")
