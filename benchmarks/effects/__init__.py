"""What each effect brings where a log calls for it, and loses where it is left out of one that does not.

genre bench effects --json docs/results/data/effects.json [--set seeds=1001] [--set effects=exposure] [--set pandaset=]
genre bench effects --set seeds=900,901 --set factors=0.5,1,2,4    # where a threshold sits: see `Case`
genre bench effects --set effects=trained --set training=FOLDER    # of `genre train gnet --recipe effects`

Each row says the commit that it was measured at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.effects.cases import CASES
from benchmarks.effects.cells import ChunkLocation, measure_on_pandaset, measure_on_street
from benchmarks.effects.report import BENCH_NAME, make_claims, make_table
from benchmarks.effects.whole_plans import (
    TRAINED_EFFECTS,
    compare_auto_with_on,
    compare_trained,
    count_plain_cost,
    describe_training,
)
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

CELL_S = 120.0
WHOLE_PLAN_S = 200.0
COUNTED_S = 1500.0
WHOLE_PLANS: Mapping[str, tuple[Callable[[ChunkLocation], Row], float]] = {
    "auto_vs_on": (compare_auto_with_on, WHOLE_PLAN_S),
    "plain_cost": (count_plain_cost, COUNTED_S),
}
"""Whole plans, and their predicted seconds; the cost is counted on the first street alone."""
TRAINED = "trained"
"""Among the effects that are asked for: whether the optimiser gains from training with them; needs ``training``."""


class EffectsBench:
    """A cell for each effect and log: streets that call for it, streets that do not, and the real chunks."""

    name = BENCH_NAME
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003",
        "effects": ",".join((*CASES, *WHOLE_PLANS)),
        "factors": "0,4",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "chunks": "0,1",
        "training": "",
        "settings": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.effects.cells",
        "benchmarks.effects.whole_plans",
        "benchmarks.effects.instruction_count",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {"seeds": TINY_STREET, "effects": "exposure", "factors": "4", "settings": TINY_SETTINGS}, "exposure street"
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists whole plans, training, then each effect; ``quick``: one street, no real log.

        Args:
            options: factor 0 is the street that does not call for the effect.
            quick: fewer runs.

        Raises:
            ConfigError: there is no such effect.
        """
        seeds = split_option(options["seeds"])
        seeds = seeds[:1] if quick else seeds
        # A quick run has to work on machines without the real log.
        chunks = [int(c) for c in split_option(options["chunks"])] if options["pandaset"] and not quick else []
        settings = settings_from_options(options)
        maker = _CellMaker(options["store"], options["pandaset"], settings)
        names = split_option(options["effects"])
        known = (*CASES, *WHOLE_PLANS, TRAINED)
        for name in names:
            # A typo would measure nothing, and its claims would fail without a reason.
            if name not in known:
                remedy = f"{did_you_mean(name, known)}Known: {', '.join(known)}."
                raise ConfigError(f"nothing is measured of {name!r}", remedy=remedy)
        cells = []
        for name in names:
            if name in WHOLE_PLANS:
                # Counting instructions takes far longer than the rest, so it is done on the first street alone.
                cells += [maker.full_plan(name, s) for s in (seeds[:1] if name == "plain_cost" else seeds)]
        if TRAINED in names:
            cells += maker.trained(seeds, chunks, options["training"])
        for name in names:
            if name in CASES:
                factors = [float(f) for f in split_option(options["factors"])]
                if CASES[name].plain is None:
                    factors = [f for f in factors if f > 0]
                cells += [maker.street(name, s, f) for s in seeds for f in factors]
                cells += [maker.real(name, chunk) for chunk in chunks]
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims, see :func:`benchmarks.effects.report.make_claims`."""
        return make_claims(rows)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a line for each cell."""
        return make_table(rows)


class _CellMaker:
    """Makes cells of one store and configuration."""

    def __init__(self, store: str, pandaset: str, settings: tuple[str, ...]) -> None:
        self._store = store
        self._pandaset = pandaset
        self._settings = settings
        config = load_configuration("small", settings=settings)
        weights = digest_stage_weights(STAGE_BY_NAME["gnet"], config)
        self._parameters = {"configuration": config.model_dump(mode="json"), "weights": weights}

    def full_plan(self, name: str, seed: str) -> Cell:
        """Makes a cell of ``WHOLE_PLANS``."""
        measure, seconds = WHOLE_PLANS[name]
        location = self._location(f"synthetic:street?seed={seed}", 0)
        return Cell(f"{name} street {seed}", seconds, partial(measure, location), self._parameters)

    def trained(self, seeds: list[str], chunks: list[int], folder: str) -> list[Cell]:
        """Makes cells that compare weights: two for each street, one for each real chunk."""
        # Each street is taken without effects too: training with them must not cost quality where there are none.
        locations = [
            self._location(f"synthetic:street?seed={seed}{query}", 0)
            for seed in seeds
            for query in ("", TRAINED_EFFECTS)
        ]
        locations += [self._location(f"pandaset:{self._pandaset}", chunk) for chunk in chunks]
        # A training that goes on changes its weights, and so does another folder.
        parameters = self._parameters | {"training": describe_training(folder)}
        return [
            Cell(f"{TRAINED} {x.log} chunk {x.chunk}", WHOLE_PLAN_S, partial(compare_trained, x, folder), parameters)
            for x in locations
        ]

    def street(self, name: str, seed: str, factor: float) -> Cell:
        """Makes a cell of one effect on a street."""
        measure = partial(measure_on_street, name, seed, self._store, self._settings, factor)
        return Cell(f"{name} street {seed} x {factor:g}", CELL_S, measure, self._parameters)

    def real(self, name: str, chunk: int) -> Cell:
        """Makes a cell of one effect on a chunk of the real sequence."""
        measure = partial(measure_on_pandaset, name, self._location(f"pandaset:{self._pandaset}", chunk))
        return Cell(f"{name} {self._pandaset} chunk {chunk}", CELL_S, measure, self._parameters)

    def _location(self, log: str, chunk: int) -> ChunkLocation:
        return ChunkLocation(log, chunk, self._store, self._settings)


EFFECTS: Bench = EffectsBench()
