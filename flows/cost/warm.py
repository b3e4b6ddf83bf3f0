"""What the first stage of each kind in a process takes beyond the later ones: imports, weights, first calls."""

from __future__ import annotations

import tempfile

from flows.cost.cell import Cell, Sweep, run_cell
from flows.cost.knobs import PRESET_ITSELF, Setting
from flows.produce import produce

TINY = "synthetic:street?seed=900&frames=8&cameras=1"


def cold_seconds(sweep: Sweep) -> dict[str, float]:
    """By stage, of the preset on a tiny log: the seconds of the first run less those of the second, at least 0.

    Afterwards the process is warm: a sweep's seconds then hold none of it.
    """
    twice = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as store:
            row = run_cell(
                Sweep(sweep.preset, sweep.settings, store), Cell(TINY, 0, 0, Setting(PRESET_ITSELF, "")), produce
            )
            assert row is not None
            twice.append(row["seconds"])
    first, second = twice
    return {stage: max(0.0, first[stage] - second[stage]) for stage in first}
