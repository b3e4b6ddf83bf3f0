"""The learned optimiser's claims, measured: GNet's wall time and renders beside those of its baselines.

genre bench optimiser --json docs/benchmarks/optimiser.json [--set seeds=1001 --set orders=0 --set cap=10]

A log and an order of views (a seed) make a cell with each method; GNet runs in each of them anew, before the method.
A baseline's run ends where it reaches GNet's held-out PSNR, or at ``cap`` times GNet's seconds.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

from benchmarks.bench import Bench, Cell, NotMeasuredError, Row
from benchmarks.optimiser import summary, table
from benchmarks.optimiser.cells import METHODS, measure_race, measure_stability, variants
from benchmarks.optimiser.network import COUNTS, measure_network
from benchmarks.schema import Claim
from flows.configuration import load_configuration
from flows.pipeline import BY_NAME, weights_digest, weights_file
from genre_tasks.optimiser.run import step_rule

GNET_S = 10.0
"""Predicted for GNet on a synthetic street; the real one has twice the views."""
QUICK_CAP = 10.0


class Optimiser:
    """Cells of races, of stability, and of the network alone."""

    name = "optimiser"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005", "orders": "0,1,2", "methods": ",".join(METHODS), "cap": "50",
        "minutes": "", "store": "genre-store", "pandaset": "../shared/data/pandaset/002",
    }  # fmt: skip
    code: tuple[str, ...] = (
        "benchmarks.optimiser.cells", "benchmarks.optimiser.network", "benchmarks.optimiser.race",
        "benchmarks.optimiser.task", "benchmarks.raster.scenes", "benchmarks.timing", "genre_tasks.optimiser.run",
        "genre_tasks.stages.ingest", "genre_tasks.stages.initial", "genre_tasks.logs.pandaset",
        "genre_tasks.logs.synthetic",
    )  # fmt: skip

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """The network; then for each order each method on all logs; ``quick``: one seed, one order, a lower cap.

        An empty ``pandaset`` leaves the real log out; with ``minutes`` cells that would not end by then are left out.
        """
        logs = [(f"synthetic:street?seed={seed}", 0, GNET_S) for seed in _parts(options["seeds"])]
        if options["pandaset"]:
            logs.append((f"pandaset:{options['pandaset']}", 1, 2 * GNET_S))
        logs, orders = (logs[:1], _parts(options["orders"])[:1]) if quick else (logs, _parts(options["orders"]))
        cap = min(float(options["cap"]), QUICK_CAP) if quick else float(options["cap"])
        config, store = load_configuration("small"), options["store"]
        digest = weights_digest(weights_file(BY_NAME["gnet"], config))
        shared = {"configuration": config.model_dump(mode="json"), "weights": digest}
        rounds = 3 if quick else 9
        network = partial(measure_network, partial(step_rule, "gnet", config.gnet), COUNTS, rounds)
        out = [Cell("network", 5.0 * (rounds + 2), network, shared | {"rounds": rounds})]
        for order, method in itertools.product(map(int, orders), _parts(options["methods"])):
            configs = {name: c.model_dump(mode="json") for name, c in variants(method).items()}
            for log, chunk, gnet_s in logs:
                measure = partial(measure_race, log, chunk, store, order, method, cap)
                seconds = 1.2 * gnet_s * (1 + cap * len(configs))
                parameters = shared | {"cap": cap, "variants": configs}
                out.append(Cell(f"{log} chunk {chunk} order {order} {method}", seconds, measure, parameters))
        for log, chunk, gnet_s in logs:
            stability = partial(measure_stability, log, chunk, store)
            out.append(Cell(f"stability/{log} chunk {chunk}", 11 * gnet_s, stability, shared))
        if options["minutes"]:
            out = [_before(time.monotonic() + 60 * float(options["minutes"]), cell) for cell in out]
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """See :mod:`benchmarks.optimiser.summary`."""
        return summary.claims(rows)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """The tables that the documents show."""
        return table.markdown(rows)


def _before(deadline: float, cell: Cell) -> Cell:
    """The cell, which refuses to be measured where it would end after the deadline."""

    def measure() -> Row:
        if time.monotonic() + cell.seconds > deadline:
            raise NotMeasuredError("left out: it would not have ended in the minutes given")
        return cell.measure()

    return replace(cell, measure=measure)


def _parts(text: str) -> list[str]:
    return [part for part in text.split(",") if part]


BENCH: Bench = Optimiser()
