"""What FNet brings beside the path and what it costs, as the preset ``small`` uses it.

genre bench fixer --json docs/results/data/fixer.json [--set seeds=1001] [--set pandaset=]

A log makes a cell. Views at 3 m are those that the optimiser's benchmark evaluates by: spread over sides, frames and
cameras, none of them seen by any stage. Fixers of fewer inputs are measured too where ``--set ablations=FOLDER`` has
them, each trained as long as the others by ``genre train fnet --inputs …``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    logs_from_options,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.fixer.cells import FixerCase, find_ablation_weights, measure_fixer
from benchmarks.fixer.report import make_claims, make_table
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights, digest_weights

CELL_S = 200.0
"""Predicted: the stages before FNet, twelve ray-cast views, a few hundred fixed ones."""


class FixerBench:
    """A cell for each log."""

    name = "fixer"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "ablations": "training",
        "gate_shifts": "0.25,0.5,1,2,3",
        "timed_runs": "3",
        "settings": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.fixer.cells",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {
            "seeds": TINY_STREET,
            "pandaset": "",
            "ablations": "nowhere",
            "gate_shifts": "1",
            "timed_runs": "1",
            "settings": TINY_SETTINGS,
        },
        "street",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists a cell for each log; ``quick``: the first one. An empty ``pandaset`` leaves the real log out."""
        logs = logs_from_options(options)
        settings = settings_from_options(options)
        config = load_configuration("small", settings=settings)
        digests = [digest_stage_weights(STAGE_BY_NAME[name], config) for name in ("gnet", "fnet")]
        ablations = find_ablation_weights(options["ablations"])
        gate_shifts_m = tuple(float(x) for x in split_option(options["gate_shifts"]))
        timed_runs = int(options["timed_runs"])
        parameters = {
            "configuration": config.model_dump(mode="json"),
            "weights": digests,
            # Digests and not paths: a folder may hold other weights the next time.
            "ablations": {inputs: digest_weights(path) for inputs, path in ablations.items()},
            "gate_shifts_m": list(gate_shifts_m),
            "timed_runs": timed_runs,
        }
        cells = []
        for log, chunk in logs[:1] if quick else logs:
            case = FixerCase(log, chunk, options["store"], options["ablations"], gate_shifts_m, timed_runs, settings)
            cells.append(Cell(f"{log} chunk {chunk}", CELL_S, partial(measure_fixer, case), parameters))
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims, see :func:`benchmarks.fixer.report.make_claims`."""
        return make_claims(rows)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives the tables, see :func:`benchmarks.fixer.report.make_table`."""
        return make_table(rows)


BENCH: Bench = FixerBench()
