"""Whether budgets are kept and used, and whether the reliable range tells good views from bad ones.

genre bench evaluation --json FILE [--set rounds=1] [--set seeds=1001] [--set budgets=1.2,2]

Budgets are multiples of a street's shortest run. A round runs each budget once, on the seeds in turn; the next one
shifts the seeds by one, until five rounds have every budget on every seed.
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
    list_not_measured,
    settings_from_options,
    split_option,
)
from benchmarks.common.cell_parameters import describe_preset
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.evaluation.budgets import budget_claims, budget_table, digest_table, run_with_multiple
from benchmarks.evaluation.range_seconds import measure_range_seconds, range_seconds_claims, range_seconds_table
from benchmarks.evaluation.reliability import measure_street, reliability_claims, reliability_table

GUARDS_S = 150.0
RANGE_S = 90.0
START_S = 30.0
"""What a command takes beyond its budget: start of Python and Prefect, evaluation, report."""
SHORTEST_S = 50.0
"""What the shortest run takes on two cores: start-up, drawing a street and GNet's first iterations."""


class EvaluationBench:
    """A cell for each budget and seed, one for each seed's guards, and one for the seconds of a reliable range."""

    name = "evaluation"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005",
        "budgets": "1.1,1.15,1.25,1.35,1.45,1.55,1.7,1.9,2.1,2.5",
        "rounds": "5",
        "range_log": "pandaset:../shared/data/pandaset/002",
        "stages": "gnet,enet",
        "store": "genre-store",
        "table": "",
        "settings": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.evaluation.budgets",
        "benchmarks.evaluation.range_seconds",
        "benchmarks.evaluation.reliability",
        "flows.budget.budget",
        "flows.cli.run",
        "genre_tasks.reliability.reliable_range",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {"seeds": TINY_STREET, "stages": "gnet", "budgets": "", "settings": TINY_SETTINGS}, "guards street"
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the guards of each seed, the budgets and a range; ``quick``: one round, one seed's guards."""
        seeds = split_option(options["seeds"])
        budgets = split_option(options["budgets"])
        settings = settings_from_options(options)
        parameters = describe_preset("small", settings)
        # The table alone decides what a budget is spent on; a sweep writes a new one over the old one.
        planned = parameters | {"table": digest_table(options["table"])}
        cells = []
        for seed in seeds[:1] if quick else seeds:
            for stage in split_option(options["stages"]):
                guards = partial(measure_street, seed, stage, options["store"], settings)
                cells.append(Cell(f"guards street {seed} {stage}", GUARDS_S, guards, parameters))
        # More rounds than seeds would only repeat cells.
        for k in range(1 if quick else min(len(seeds), int(options["rounds"]))):
            for i, budget in enumerate(budgets):
                # Shifted by one each round, so that after some rounds every budget has met every seed.
                seed = seeds[(i + k) % len(seeds)]
                run = partial(run_with_multiple, seed, float(budget), options["table"], settings)
                # The street's shortest run comes before each.
                seconds = (1.0 + float(budget)) * SHORTEST_S + 2.0 * START_S
                cells.append(Cell(f"budget {budget} x shortest street {seed}", seconds, run, planned))
        # One street is enough: the seconds depend on the number of views and their size.
        stage = split_option(options["stages"])[-1]
        logs = {f"street {seeds[0]}": f"synthetic:street?seed={seeds[0]}"}
        if options["range_log"] and not quick:
            # A whole chunk of it, as nothing is compared but seconds.
            logs["real chunk 0"] = options["range_log"]
        for name, log in logs.items():
            time_range = partial(measure_range_seconds, log, stage, options["store"], settings)
            cells.append(Cell(f"range {name} {stage}", RANGE_S, time_range, parameters | {"log": log}))
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Claims that budgets are kept, used and worth it, and that guards rank views as the truth does."""
        yield from budget_claims(_budget_rows(rows))
        yield from reliability_claims(_guard_rows(rows))
        yield from range_seconds_claims(_range_rows(rows))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives both tables, and what was not measured."""
        yield from budget_table(_budget_rows(rows))
        yield ""
        yield from reliability_table(_guard_rows(rows))
        yield ""
        yield from range_seconds_table(_range_rows(rows))
        yield from list_not_measured(rows)


def _budget_rows(rows: Mapping[str, Row]) -> list[Row]:
    return [r for r in rows.values() if "multiple" in r]


def _guard_rows(rows: Mapping[str, Row]) -> list[Row]:
    return [r for r in rows.values() if "views" in r]


def _range_rows(rows: Mapping[str, Row]) -> list[Row]:
    return [r for r in rows.values() if "range_s" in r]


EVALUATION: Bench = EvaluationBench()
