"""The learned optimiser's claims, measured: wall time and renders of GNet and ENet beside those of their baselines.

genre bench optimiser --json docs/benchmarks/optimiser.json [--set seeds=1001 --set orders=0 --set cap=10]

A log and an order of views (a seed) make a cell with each method; GNet runs in each of them anew, before the method.
A baseline's run ends where it reaches GNet's held-out PSNR, or at ``cap`` times GNet's seconds. A log and an order make
also a cell of enhancement, one of distillation and one of convergence. The two latter run baselines to their ends and
are the dearest: ``long_orders`` chooses their orders, ``families`` what is distilled beside ENet. All cells of the
first order come first. What GNet's length and views bring and cost is measured on validation streets. All that is
compared in a cell runs on as many ``threads``: with one, two logs can be measured at a time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from benchmarks.common.bench import Bench, Cell, NotMeasuredError, Row, logs_of
from benchmarks.common.claims import Claim
from benchmarks.common.context import threads
from benchmarks.optimiser import claims, race_table
from benchmarks.optimiser.cells import METHODS, measure_race, measure_stability, variants
from benchmarks.optimiser.convergence import LONG_RENDERS, PRESET, long_variants, measure_converged
from benchmarks.optimiser.distillation import (
    FAMILIES,
    MOST_TIMES,
    QUICK_STANDARD_ITERATIONS,
    SHORTER,
    STANDARD_ITERATIONS,
    adam_variants,
    measure_distillation,
)
from benchmarks.optimiser.enhancement import as_enhancer, measure_enhancement
from benchmarks.optimiser.iteration_tradeoff import SEEDS, measure_trade, settings
from benchmarks.optimiser.network_speed import COUNTS, measure_network
from flows.configuration import load_configuration
from flows.pipeline.definition import BY_NAME, stage_weights
from genre_tasks.config import GnetConfig, OptimiserConfig, PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.stages.optimise import StageName, step_rule

RENDER_S, STEP_S, JUDGE_S = 0.012, 0.02, 0.2
"""Predicted for a view with its gradient at 40k Gaussians, a step of a network, and a look at a scene."""
QUICK_CAP = 10.0
PARTS = ("race", "enhancement", "distillation", "converged", "stability", "trade")
SLOWER_3DGS = 4.0
"""Per-scene 3DGS grows to several times as many Gaussians."""
NETWORKS: tuple[StageName, ...] = ("gnet", "enet")
"""Those that are run far past their lengths."""
CLAIMED = ("tuned_adam", "standard_3dgs")
"""The methods that claims are about; tuned Adam on split Gaussians and street_gs stand beside them in the tables."""


class Optimiser:
    """Cells of races, of stability, and of the network alone."""

    name = "optimiser"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005",
        "orders": "0,1,2",
        "long_orders": "0,1,2",
        "methods": ",".join(METHODS),
        "parts": ",".join(PARTS),
        "families": ",".join(FAMILIES),
        "cap": "50",
        "threads": "2",
        "minutes": "",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
    }
    code: tuple[str, ...] = (
        "benchmarks.optimiser.cells",
        "benchmarks.optimiser.network_speed",
        "benchmarks.optimiser.race",
        "benchmarks.common.task",
        "benchmarks.raster.scenes",
        "benchmarks.common.timing",
        "genre_tasks.stages.optimise",
        "benchmarks.common.novel_view_truth",
        "benchmarks.optimiser.convergence",
        "benchmarks.optimiser.distillation",
        "benchmarks.optimiser.enhancement",
        "benchmarks.common.pipeline_inputs",
        "benchmarks.optimiser.iteration_tradeoff",
        "genre_tasks.stages.novel_views",
        "genre_tasks.stages.fnet",
        "genre_tasks.stages.ingest",
        "genre_tasks.stages.initial",
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """The network; then for each order every part on all logs.

        ``quick``: one seed, one order, a lower cap, the methods of claims, a shorter standard recipe.
        An empty ``pandaset`` leaves the real log out; with ``minutes`` cells that would not end by then are left out.
        The network alone has two threads in any case. Raises ``ConfigError`` for an unknown part, family or method.
        """
        logs = logs_of(options)
        orders, methods = _parts(options["orders"]), _known("method", options["methods"], METHODS)
        parts, families = _known("part", options["parts"], PARTS), _known("family", options["families"], FAMILIES)
        if quick:
            logs, orders, methods = logs[:1], orders[:1], [m for m in methods if m in CLAIMED]
        cap = min(float(options["cap"]), QUICK_CAP) if quick else float(options["cap"])
        made = _Maker(load_configuration("small"), load_configuration(PRESET), options["store"], cap, quick)
        network = made.network(3 if quick else 9)
        out: list[Cell] = []
        if "trade" in parts:
            out += [made.trade(seed) for seed in SEEDS[: 1 if quick else None]]
        for order in map(int, orders):
            if "race" in parts:
                out += [made.race(*log, order, m) for m in methods for log in logs]
            if "enhancement" in parts:
                out += [made.enhancement(*log, order) for log in logs]
            if str(order) in _parts(options["long_orders"]):
                out += [made.distillation(*log, order, families) for log in logs if "distillation" in parts]
                out += [made.converged(*log, order) for log in logs if "converged" in parts]
            if order == int(orders[0]) and "stability" in parts:
                out += [made.stability(*log, network) for network in NETWORKS for log in logs]
        out = [network, *(_on(int(options["threads"]), cell) for cell in out)]
        if options["minutes"]:
            out = [_before(time.monotonic() + 60 * float(options["minutes"]), cell) for cell in out]
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """See :mod:`benchmarks.optimiser.claims`."""
        return claims.claims(rows)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """The tables that the documents show."""
        return race_table.markdown(rows)


class _Maker:
    """Makes the cells, each with a prediction of its seconds from its renders and steps."""

    def __init__(self, small: PipelineConfig, long: PipelineConfig, store: str, cap: float, quick: bool) -> None:
        self._small, self._long, self._store, self._cap, self._quick = small, long, store, cap, quick
        self._gnet_s = _learned_s(small.gnet)
        digests = [stage_weights(BY_NAME[name], small) for name in ("gnet", "fnet", "enet")]
        self._gnet = {"configuration": small.model_dump(mode="json"), "weights": digests[0]}
        self._all = {"configuration": small.model_dump(mode="json"), "weights": digests}

    def network(self, rounds: int) -> Cell:
        rule = partial(step_rule, "gnet", self._small.gnet)
        measure = partial(measure_network, rule, COUNTS, rounds)
        return Cell("network", 5.0 * (rounds + 2), measure, self._gnet | {"rounds": rounds})

    def trade(self, seed: int) -> Cell:
        configs = settings(self._small.gnet)
        measure = partial(measure_trade, f"synthetic:street?seed={seed}", self._store, configs)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        seconds = sum(map(_learned_s, configs.values()))
        return Cell(f"trade/street {seed}", seconds, measure, self._gnet | {"settings": values})

    def race(self, log: str, chunk: int, order: int, method: str) -> Cell:
        configs = variants(method)
        seconds = self._gnet_s + sum(_baseline_s(c, self._gnet_s, self._cap) for c in configs.values())
        measure = partial(measure_race, log, chunk, self._store, order, method, self._cap)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        parameters = self._gnet | {"cap": self._cap, "variants": values}
        return Cell(f"{log} chunk {chunk} order {order} {method}", seconds, measure, parameters)

    def enhancement(self, log: str, chunk: int, order: int) -> Cell:
        own = self._gnet_s + _learned_s(self._small.enet) + _learned_s(as_enhancer(self._small))
        measure = partial(measure_enhancement, log, chunk, self._store, order)
        return Cell(f"enhancement/{log} chunk {chunk} order {order}", own + 25.0, measure, self._all)

    def distillation(self, log: str, chunk: int, order: int, families: Sequence[str]) -> Cell:
        enet_s, configs = _learned_s(self._small.enet), dict[str, OptimiserConfig]()
        if "adam" in families:
            configs |= adam_variants(self._small.enet)
        if (split := self._small.enet.split_fraction) and "adam_split" in families:
            configs |= adam_variants(self._small.enet, split)
        seconds = enet_s * (1 + sum(SHORTER) + MOST_TIMES * len(configs))
        standard = QUICK_STANDARD_ITERATIONS if self._quick else STANDARD_ITERATIONS
        if "standard" in families:
            seconds += SLOWER_3DGS * RENDER_S * standard
        measure = partial(measure_distillation, log, chunk, self._store, order, self._cap, standard, families)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        name = f"distillation/{log} chunk {chunk} order {order}"
        if set(families) != set(FAMILIES):
            name += f" {'+'.join(families)}"
        parameters = self._all | {"cap": self._cap, "variants": values, "standard": standard, "families": families}
        return Cell(name, seconds + 20.0, measure, parameters)

    def converged(self, log: str, chunk: int, order: int) -> Cell:
        configs = long_variants(variants("tuned_adam"))
        renders = [c.iterations * c.views_per_iteration for c in configs.values() if c.adam.schedule == "cosine"]
        renders += [LONG_RENDERS] * (len(configs) - len(renders))  # what is constant settles about there
        seconds = _learned_s(self._long.gnet) + RENDER_S * sum(renders) + 15 * JUDGE_S * len(configs)
        measure = partial(measure_converged, log, chunk, self._store, order, self._cap)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        parameters = self._gnet | {"cap": self._cap, "variants": values, "long": self._long.model_dump(mode="json")}
        return Cell(f"converged/{log} chunk {chunk} order {order}", seconds, measure, parameters)

    def stability(self, log: str, chunk: int, network: StageName) -> Cell:
        measure = partial(measure_stability, log, chunk, self._store, network)
        if network == "gnet":
            return Cell(f"stability/{log} chunk {chunk}", 11 * self._gnet_s, measure, self._gnet)
        seconds = self._gnet_s + 11 * _learned_s(self._small.enet) + 20.0
        return Cell(f"stability/enet {log} chunk {chunk}", seconds, measure, self._all)


def _learned_s(config: OptimiserConfig) -> float:
    """Of a learned optimiser to its end."""
    views = config.views_per_iteration + config.novel_views_per_iteration
    return config.iterations * (RENDER_S * views + STEP_S)


def _baseline_s(config: GnetConfig, gnet_s: float, cap: float) -> float:
    """Of a baseline's race: tuned Adam gets there early or has its length; per-scene 3DGS needs the cap at worst."""
    if config.method == "adam":
        length = RENDER_S * config.iterations * config.views_per_iteration
        return min(cap * gnet_s, length if config.adam.schedule == "cosine" else 4 * gnet_s) + 15 * JUDGE_S
    return cap * gnet_s + 20 * JUDGE_S


def _on(count: int, cell: Cell) -> Cell:
    """The cell measured on so many threads; its row says so."""

    def measure() -> Row:
        with threads(count):
            return {"threads": count, **cell.measure()}

    return replace(cell, measure=measure, parameters={**cell.parameters, "threads": count})


def _before(deadline: float, cell: Cell) -> Cell:
    """The cell, which refuses to be measured where it would end after the deadline."""

    def measure() -> Row:
        if time.monotonic() + cell.seconds > deadline:
            raise NotMeasuredError("left out: it would not have ended in the minutes given")
        return cell.measure()

    return replace(cell, measure=measure)


def _known(kind: str, text: str, known: Sequence[str]) -> list[str]:
    parts = _parts(text)
    if unknown := set(parts) - set(known):
        raise ConfigError(f"the benchmark has no {kind} {sorted(unknown)}", remedy=f"Known: {', '.join(known)}.")
    return parts


def _parts(text: str) -> list[str]:
    return [part for part in text.split(",") if part]


BENCH: Bench = Optimiser()
