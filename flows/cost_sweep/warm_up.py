"""What the first stage of each kind in a process takes beyond the later ones: imports, weights, first calls."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence

from flows.configuration import load_configuration
from flows.cost_sweep.cell import Cell, Sweep, run_cell
from flows.cost_sweep.knobs import PRESET_ITSELF, Setting
from flows.pipeline.stage_runner import Job, produce

TINY = "synthetic:street?seed=900&frames=8&cameras=1"


def read_before(sweep: Sweep, cells: Sequence[Cell]) -> None:
    """Ingests each chunk of the cells once, into nowhere, so that none of them pays for a log's first reading.

    A synthetic street draws its images when they are first asked for, which takes longer than all else of ingest.
    """
    for log, chunk in dict.fromkeys((c.log, c.chunk) for c in cells):
        config = load_configuration(sweep.preset, settings=sweep.settings).model_dump(mode="json")
        with tempfile.TemporaryDirectory() as store:
            produce("ingest", Job(log, chunk, store, config), {})


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
