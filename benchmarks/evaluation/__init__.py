"""Whether budgets are kept and used, and whether the reliable range tells good views from bad ones.

genre bench evaluation --json docs/benchmarks/evaluation.json [--set rounds=1] [--set seeds=1001] [--set budgets=30,60]

A round runs each budget once, on the seeds in turn; the next one shifts the seeds by one, until five rounds have every
budget on every seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from benchmarks.common.bench import Cell, Row
from benchmarks.common.claims import Claim
from benchmarks.evaluation.budgets import claims_of as budget_claims
from benchmarks.evaluation.budgets import run_within
from benchmarks.evaluation.budgets import table_of as budget_table
from benchmarks.evaluation.reliability import claims_of as reliability_claims
from benchmarks.evaluation.reliability import ranked
from benchmarks.evaluation.reliability import table_of as reliability_table
from flows.configuration import load_configuration
from flows.pipeline.definition import BY_NAME, stage_weights

RANKED_S, START_S = 150.0, 30.0


class Evaluation:
    """A cell for each budget and seed, and one for each seed's guards.

    Budgets start where the shortest setting ends on two cores: start-up, drawing a street and GNet's first iterations
    take some 48 seconds.
    """

    name = "evaluation"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005",
        "budgets": "52,56,60,65,70,75,80,90,100,120",
        "rounds": "5",
        "stages": "gnet,enet",
        "store": "genre-store",
        "table": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.evaluation.budgets",
        "benchmarks.evaluation.reliability",
        "flows.budget.budget",
        "genre_tasks.reliability.guards",
        "genre_tasks.stages.ingest",
        "genre_tasks.stages.initial",
        "genre_tasks.stages.optimise",
        "genre_tasks.stages.fnet",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """``quick``: one round, one seed's guards."""
        seeds, budgets, stages = ([x for x in options[k].split(",") if x] for k in ("seeds", "budgets", "stages"))
        small = load_configuration("small")
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": [stage_weights(BY_NAME[s], small) for s in ("gnet", "fnet", "enet")],
            "table": options["table"],
        }
        out = []
        for seed in seeds[:1] if quick else seeds:
            for stage in stages:
                measure = partial(ranked, seed, stage, options["store"])
                out.append(Cell(f"guards street {seed} {stage}", RANKED_S, measure, parameters))
        for k in range(1 if quick else min(len(seeds), int(options["rounds"]))):
            for i, budget in enumerate(budgets):
                seed = seeds[(i + k) % len(seeds)]
                measure = partial(run_within, seed, float(budget), options["table"])
                out.append(Cell(f"budget {budget} s street {seed}", float(budget) + START_S, measure, parameters))
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Budgets kept, used, and worth it; guards in the order of the truth."""
        yield from budget_claims([r for r in rows.values() if "budget_s" in r])
        yield from reliability_claims([r for r in rows.values() if "views" in r])

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Both tables, and what was not measured."""
        yield from budget_table([r for r in rows.values() if "budget_s" in r])
        yield ""
        yield from reliability_table([r for r in rows.values() if "views" in r])
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


EVALUATION = Evaluation()
