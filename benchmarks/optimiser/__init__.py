"""The learned optimiser's claims, measured: wall time and renders of GNet and ENet against their baselines.

genre bench optimiser --json docs/results/data/optimiser.json [--set seeds=1001 --set orders=0 --set cap=10]

A log and an order of views (a seed) make a cell with each method; GNet runs in each of them anew, before the method.
A baseline's run ends where it reaches GNet's held-out PSNR, or at ``cap`` times GNet's seconds; tuned Adam's already at
``adam_cap`` times. A log and an order make also a cell of enhancement, one of distillation and one of convergence. The
two latter run baselines to their ends and are the dearest: ``long_orders`` chooses their orders, ``families`` what is
distilled beside ENet. All cells of the first order come first. What GNet's length and views bring and cost is measured
on validation streets. All that is compared in a cell runs on as many ``threads``: with one, two logs can be measured at
a time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    NotMeasuredError,
    Row,
    SmallestForm,
    logs_from_options,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.optimiser import claims, race_table
from benchmarks.optimiser.cells import ADAM, METHODS, measure_race, measure_stability, variants
from benchmarks.optimiser.convergence import LONG_RENDERS, PRESET, long_variants, measure_converged
from benchmarks.optimiser.distillation import (
    FAMILIES,
    MAX_TIME_RATIO,
    QUICK_STANDARD_ITERATIONS,
    SHORTER,
    STANDARD_ITERATIONS,
    adam_variants,
    measure_distillation,
)
from benchmarks.optimiser.enhancement import gnet_as_enhancer, measure_enhancement
from benchmarks.optimiser.iteration_tradeoff import SEEDS, measure_trade, variant_configs
from benchmarks.optimiser.network_speed import COUNTS, measure_network
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from genre_tasks.config import GnetConfig, OptimiserConfig
from genre_tasks.errors import ConfigError
from genre_tasks.stages.optimise import StageName, load_step_rule
from genre_tasks.threads import torch_threads

RENDER_S = 0.012
STEP_S = 0.02
SCORE_S = 0.2
"""Predicted for a view with its gradient at 40k Gaussians, a step of a network, and the scoring of a scene."""
QUICK_CAP = 10.0
PARTS = ("race", "enhancement", "distillation", "converged", "stability", "trade")
SLOWER_3DGS = 4.0
"""Per-scene 3DGS grows to several times as many Gaussians."""
NETWORKS: tuple[StageName, ...] = ("gnet", "enet")
"""Those that are run far past their lengths."""
CLAIMED = ("tuned_adam", "standard_3dgs")
"""The methods that claims are about; tuned Adam on split Gaussians and street_gs are in the tables only."""


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
        "adam_cap": "5",
        "threads": "2",
        "minutes": "",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "settings": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.optimiser.cells",
        "benchmarks.optimiser.network_speed",
        "benchmarks.optimiser.race",
        "benchmarks.common.task",
        "benchmarks.raster.scenes",
        "benchmarks.common.timing",
        "benchmarks.common.novel_view_truth",
        "benchmarks.optimiser.convergence",
        "benchmarks.optimiser.distillation",
        "benchmarks.optimiser.distillation_scores",
        "benchmarks.optimiser.enhancement",
        "benchmarks.common.pipeline_inputs",
        "benchmarks.optimiser.iteration_tradeoff",
        # It scores the scenes.
        "flows.training.optimiser_training",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {
            "seeds": TINY_STREET,
            "pandaset": "",
            "orders": "0",
            "parts": "race",
            "cap": "1",
            "adam_cap": "1",
            "threads": "1",
            "settings": TINY_SETTINGS,
        },
        only="order 0 tuned_adam",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the network's cell, then for each order every part on all logs.

        Args:
            options: of the command line. An empty ``pandaset`` leaves the real log out; with ``minutes``, cells that
                would not end by then are left out.
            quick: one seed, one order, a lower cap, the methods of claims, a shorter standard recipe.

        Returns:
            Cells in the order in which they are measured.

        Raises:
            ConfigError: a part, family or method is unknown.
        """
        logs = logs_from_options(options)
        orders = split_option(options["orders"])
        methods = _known("method", options["methods"], METHODS)
        parts = _known("part", options["parts"], PARTS)
        families = _known("family", options["families"], FAMILIES)
        # A quick run shows that everything works; its numbers are not committed.
        if quick:
            logs = logs[:1]
            orders = orders[:1]
            methods = [method for method in methods if method in CLAIMED]
        # Per-scene methods run until the cap, so it decides how long a quick run takes.
        cap = min(float(options["cap"]), QUICK_CAP) if quick else float(options["cap"])
        settings = settings_from_options(options)
        factory = _CellFactory(options["store"], cap, float(options["adam_cap"]), quick, settings)
        network = factory.network(3 if quick else 9)
        out: list[Cell] = []
        if "trade" in parts:
            out += [factory.trade(seed) for seed in SEEDS[: 1 if quick else None]]
        # Orders are outermost: a run that is stopped early has every log and part once.
        for order in map(int, orders):
            if "race" in parts:
                out += [factory.race(*log, order, m) for m in methods for log in logs]
            if "enhancement" in parts:
                out += [factory.enhancement(*log, order) for log in logs]
            if str(order) in split_option(options["long_orders"]):
                out += [factory.distillation(*log, order, families) for log in logs if "distillation" in parts]
                out += [factory.converged(*log, order) for log in logs if "converged" in parts]
            if order == int(orders[0]) and "stability" in parts:
                out += [factory.stability(*log, network) for network in NETWORKS for log in logs]
        # The network alone has two threads in any case: its claim is about two.
        out = [network, *(_with_threads(int(options["threads"]), cell) for cell in out)]
        if options["minutes"]:
            out = [_with_deadline(time.monotonic() + 60 * float(options["minutes"]), cell) for cell in out]
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes every claim, see :mod:`benchmarks.optimiser.claims`."""
        return claims.claims(rows)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the tables that the documents show."""
        return race_table.markdown(rows)


class _CellFactory:
    """Makes the cells, each with a prediction of its seconds from its renders and steps."""

    def __init__(self, store: str, cap: float, adam_cap: float, quick: bool, over_preset: tuple[str, ...]) -> None:
        self._store = store
        self._cap = cap
        # Tuned Adam at constant rates never ends, and gains nothing after a few times GNet's seconds.
        self._adam_cap = adam_cap
        self._quick = quick
        self._over_preset = over_preset
        small = load_configuration("small", settings=over_preset)
        self._small = small
        self._long = load_configuration(PRESET, settings=over_preset)
        self._gnet_s = _learned_s(small.gnet)
        # Weights by their bytes: a path would let a cached row outlive a training.
        digests = [digest_stage_weights(STAGE_BY_NAME[name], small) for name in ("gnet", "fnet", "enet")]
        self._gnet = {"configuration": small.model_dump(mode="json"), "weights": digests[0]}
        self._all = {"configuration": small.model_dump(mode="json"), "weights": digests}

    def network(self, rounds: int) -> Cell:
        """Makes the cell of the network alone."""
        rule = partial(load_step_rule, "gnet", self._small.gnet)
        measure = partial(measure_network, rule, COUNTS, rounds)
        return Cell("network", 5.0 * (rounds + 2), measure, self._gnet | {"rounds": rounds})

    def trade(self, seed: int) -> Cell:
        """Makes the cell of GNet's length and views on a validation street."""
        configs = variant_configs(self._small.gnet)
        measure = partial(measure_trade, f"synthetic:street?seed={seed}", self._store, configs, self._over_preset)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        seconds = sum(map(_learned_s, configs.values()))
        return Cell(f"trade/street {seed}", seconds, measure, self._gnet | {"settings": values})

    def race(self, log: str, chunk: int, order: int, method: str) -> Cell:
        """Makes the race of one method on one log."""
        configs = variants(method)
        cap = self._adam_cap if method in ADAM else self._cap
        seconds = self._gnet_s + sum(_baseline_s(c, self._gnet_s, cap) for c in configs.values())
        measure = partial(measure_race, log, chunk, self._store, order, method, cap, self._over_preset)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        parameters = self._gnet | {"cap": cap, "variants": values}
        return Cell(f"{log} chunk {chunk} order {order} {method}", seconds, measure, parameters)

    def enhancement(self, log: str, chunk: int, order: int) -> Cell:
        """Makes the cell that compares GNet, ENet and GNet in ENet's place."""
        seconds = self._gnet_s + _learned_s(self._small.enet) + _learned_s(gnet_as_enhancer(self._small))
        measure = partial(measure_enhancement, log, chunk, self._store, order, self._over_preset)
        return Cell(f"enhancement/{log} chunk {chunk} order {order}", seconds + 25.0, measure, self._all)

    def distillation(self, log: str, chunk: int, order: int, families: Sequence[str]) -> Cell:
        """Makes the cell that compares ENet with distillations; a part of the families has its name in the cell's."""
        enet_s = _learned_s(self._small.enet)
        configs: dict[str, OptimiserConfig] = {}
        if "adam" in families:
            configs |= adam_variants(self._small.enet)
        if (split := self._small.enet.split_fraction) and "adam_split" in families:
            configs |= adam_variants(self._small.enet, split)
        seconds = enet_s * (1 + sum(SHORTER) + MAX_TIME_RATIO * len(configs))
        standard = QUICK_STANDARD_ITERATIONS if self._quick else STANDARD_ITERATIONS
        if "standard" in families:
            seconds += SLOWER_3DGS * RENDER_S * standard
        where = (log, chunk, self._store, order)
        measure = partial(measure_distillation, *where, self._cap, standard, families, self._over_preset)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        name = f"distillation/{log} chunk {chunk} order {order}"
        # A part of the families is a cell of its own, whose row replaces those in the full cell.
        if set(families) != set(FAMILIES):
            name += f" {'+'.join(families)}"
        parameters = self._all | {"cap": self._cap, "variants": values, "standard": standard, "families": families}
        return Cell(name, seconds + 20.0, measure, parameters)

    def converged(self, log: str, chunk: int, order: int) -> Cell:
        """Makes the cell of the preset ``long`` against converged tuned Adam."""
        configs = long_variants(variants("tuned_adam"))
        renders = [c.iterations * c.views_per_iteration for c in configs.values() if c.adam.schedule == "cosine"]
        # A constant schedule has no length; it settles after about as many renders.
        renders += [LONG_RENDERS] * (len(configs) - len(renders))
        seconds = _learned_s(self._long.gnet) + RENDER_S * sum(renders) + 15 * SCORE_S * len(configs)
        measure = partial(measure_converged, log, chunk, self._store, order, self._cap, self._over_preset)
        values = {name: config.model_dump(mode="json") for name, config in configs.items()}
        parameters = self._gnet | {"cap": self._cap, "variants": values, "long": self._long.model_dump(mode="json")}
        return Cell(f"converged/{log} chunk {chunk} order {order}", seconds, measure, parameters)

    def stability(self, log: str, chunk: int, network: StageName) -> Cell:
        """Makes the cell of a network run far past its length."""
        measure = partial(measure_stability, log, chunk, self._store, network, self._over_preset)
        # GNet's key leaves out the other weights, so that a new fixer keeps its cached rows.
        if network == "gnet":
            return Cell(f"stability/{log} chunk {chunk}", 11 * self._gnet_s, measure, self._gnet)
        seconds = self._gnet_s + 11 * _learned_s(self._small.enet) + 20.0
        return Cell(f"stability/enet {log} chunk {chunk}", seconds, measure, self._all)


def _learned_s(config: OptimiserConfig) -> float:
    """Predicts the seconds of a learned optimiser to its end."""
    # Rendering dominates; the network costs about as much as two views.
    views = config.views_per_iteration + config.novel_views_per_iteration
    return config.iterations * (RENDER_S * views + STEP_S)


def _baseline_s(config: GnetConfig, gnet_s: float, cap: float) -> float:
    """Predicts the seconds of a baseline's race: to the cap at worst, where it has no length of its own."""
    if config.method == "adam" and config.adam.schedule == "cosine":
        length = RENDER_S * config.iterations * config.views_per_iteration
        return min(cap * gnet_s, length) + 15 * SCORE_S
    return cap * gnet_s + 20 * SCORE_S


def _with_threads(count: int, cell: Cell) -> Cell:
    """The cell measured on so many threads; its row says so."""

    def measure() -> Row:
        with torch_threads(count):
            return {"threads": count, **cell.measure()}

    return replace(cell, measure=measure, parameters={**cell.parameters, "threads": count})


def _with_deadline(deadline: float, cell: Cell) -> Cell:
    """The cell, which refuses to be measured where it would end after the deadline."""

    def measure() -> Row:
        if time.monotonic() + cell.seconds > deadline:
            raise NotMeasuredError("left out: it would not have ended in the minutes given")
        return cell.measure()

    return replace(cell, measure=measure)


def _known(kind: str, text: str, known: Sequence[str]) -> list[str]:
    parts = split_option(text)
    if unknown := set(parts) - set(known):
        raise ConfigError(f"the benchmark has no {kind} {sorted(unknown)}", remedy=f"Known: {', '.join(known)}.")
    return parts


BENCH: Bench = Optimiser()
