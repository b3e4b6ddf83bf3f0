"""What each effect brings where a log calls for it, and loses where it is left out of one that does not.

genre bench effects --json docs/benchmarks/effects.json [--set seeds=1001] [--set effects=exposure] [--set pandaset=]
genre bench effects --set seeds=900,901 --set factors=0.5,1,2,4    # where a threshold sits: see `Case`
genre bench effects --set effects=trained --set training=FOLDER    # of `genre train gnet --recipe effects`

Each row says the commit that it was measured at.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.common.bench import Cell, Row
from benchmarks.common.claims import Claim, Op
from benchmarks.common.over_cells import over_cells
from benchmarks.effects.cases import CASES
from benchmarks.effects.cells import on_real, on_street
from benchmarks.effects.whole_plans import SHAPED, auto_vs_on, plain_cost, trained
from flows.configuration import load_configuration
from flows.pipeline.definition import BY_NAME, stage_weights

CELL_S, WHOLE_S, COUNTED_S = 120.0, 200.0, 1500.0
WHOLE: Mapping[str, tuple[Callable[[str, str], Row], float]] = {
    "auto_vs_on": (auto_vs_on, WHOLE_S),
    "plain_cost": (plain_cost, COUNTED_S),
}
"""Whole plans, and their predicted seconds; the latter is counted on the first street alone."""
TRAINED = "trained"
"""Among the effects that are asked for: whether the optimiser gains from training with them; needs ``training``."""


class Effects:
    """A cell for each effect and log: streets that call for it, streets that do not, and the real chunks."""

    name = "effects"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003",
        "effects": ",".join((*CASES, *WHOLE)),
        "factors": "0,4",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "chunks": "0,1",
        "training": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.effects.cells",
        "benchmarks.effects.whole_plans",
        "benchmarks.effects.instruction_count",
        "genre_tasks.stages.optimise",
        "genre_tasks.stages.ingest",
        "genre_tasks.stages.initial",
        "genre_tasks.stages.effects",
        *BY_NAME["effects"].lazy,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Factor 0 is the street that does not call for it. ``quick``: one street, no real log."""
        seeds = [s for s in options["seeds"].split(",") if s]
        names, chunks = ([n for n in options[k].split(",") if n] for k in ("effects", "chunks"))
        factors = [float(f) for f in options["factors"].split(",") if f]
        small = load_configuration("small")
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": stage_weights(BY_NAME["gnet"], small),
        }
        if quick:
            seeds = seeds[:1]
        store, out = options["store"], []
        for name in (n for n in names if n in WHOLE):
            run, seconds = WHOLE[name]
            for seed in seeds[:1] if name == "plain_cost" else seeds:
                out.append(Cell(f"{name} street {seed}", seconds, partial(run, seed, store), parameters))
        if TRAINED in names:
            places = [(f"synthetic:street?seed={s}{more}", 0) for s in seeds for more in ("", SHAPED)]
            if options["pandaset"] and not quick:
                places += [(f"pandaset:{options['pandaset']}", int(c)) for c in chunks]
            for log, index in places:
                both = partial(trained, log, index, store, options["training"])
                out.append(Cell(f"{TRAINED} {log} chunk {index}", WHOLE_S, both, parameters))
        for name in (n for n in names if n not in WHOLE and n != TRAINED):
            for seed, factor in itertools.product(seeds, factors):
                one = partial(on_street, name, seed, store, factor)
                out.append(Cell(f"{name} street {seed} x {factor:g}", CELL_S, one, parameters))
            for chunk in chunks if options["pandaset"] and not quick else ():
                real = partial(on_real, name, options["pandaset"], int(chunk), store)
                out.append(Cell(f"{name} {options['pandaset']} chunk {chunk}", CELL_S, real, parameters))
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """For each effect: what enabling gains at four times its threshold, and loses left out of a plain street."""
        found = [r for r in rows.values() if "effect" in r]
        for name, case in CASES.items():
            kinds: tuple[tuple[float, str, Op], ...] = ((4.0, "gain", ">="), (0.0, "loss", "<"))
            for factor, claim, op in kinds:
                own = [r for r in found if r["effect"] == name and r["factor"] == factor]
                gains = [_gain(r) for r in own]
                target = (0.5 if factor else 0.1) if case.unit == "dB" else (20.0 if factor else 2.0)
                data = f"on less off; {', '.join(r['log'] for r in own) or 'not measured'}"
                yield over_cells(f"{claim}_{name}", gains, op, target, case.unit, data, bench=self.name)
        costs, lost = _of(rows, "plain_cost"), _of(rows, "auto_vs_on")
        more, less = [r["cost_percent"]["planned"] for r in costs], [_lost(r) for r in lost]
        data = "instructions of a street without actors, given its plan, over one that was not planned"
        yield over_cells("plain_cost", more, "<=", 2.0, "%", data, bench=self.name)
        data = "held out, all effects set on less as planned, of streets that have every effect"
        yield over_cells("auto_vs_on", less, "<=", 0.2, "dB", data, bench=self.name)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each cell."""
        views, took = "held out: with | without | at 3 m: with | without", "GNet, s: with | without"
        yield f"| effect | log | measured | plan | with | without | gain | {views} | {took} |"
        yield "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
        for r in (r for r in rows.values() if "effect" in r):
            value = "" if r["value"] is None else f"{r['value']:.3g} {r['property_unit']} (> {r['threshold']:g})"
            views = " | ".join(_db(r[word][k]) for k in ("heldout_db", "beside_db") for word in ("on", "off"))
            log = f"{r['log'].rpartition('/')[2].removeprefix('synthetic:')} chunk {r['chunk']}"
            measured = f"{abs(r['on']['measure']):.2f} | {abs(r['off']['measure']):.2f} | {_gain(r):+.2f} {r['unit']}"
            took = f"{r['on']['gnet_s']:.2f} | {r['off']['gnet_s']:.2f}"
            yield f"| {r['effect']} | {log} | {value} | {r['choice']} | {measured} | {views} | {took} |"
        for r in _of(rows, "auto_vs_on"):
            auto, on = (_db(r[word]["heldout_db"]) for word in ("auto", "on"))
            yield f"\n{r['log']}: held out {auto} as planned, {on} all on"
        for r in _of(rows, "plain_cost"):
            planned, planning = (r["cost_percent"][k] for k in ("planned", "planning"))
            yield f"\n{r['log']}: {planned:+.2f} % instructions with the plan given, {planning:+.2f} % with making it"
        for r in _of(rows, TRAINED):
            told = ", ".join(
                f"{word} {_db(r[word]['measure'])} and {_db(r[word]['beside_db']) or 'unknown'}"
                for word in ("shipped", "plain", "effects")
            )
            yield f"\n{r['log']} chunk {r['chunk']}: held out and at 3 m: {told}"
        for name, case in CASES.items():
            own = [r for r in rows.values() if r.get("effect") == name and r["factor"] > 0 and r["value"] is not None]
            least = 0.1 if case.unit == "dB" else 2.0
            if len({r["factor"] for r in own}) > 1 and (at := calibrated(own, least)) is not None:
                yield f"\n{name}: enabling gains {least:g} {case.unit} at {at:.3g} {own[0]['property_unit']}"
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


def _gain(row: Row) -> float:
    """What enabling brings: in dB, or in per cent of what is left without."""
    on, off = float(row["on"]["measure"]), float(row["off"]["measure"])
    return on - off if row["unit"] == "dB" else 100 * (on - off) / abs(off)


def _of(rows: Mapping[str, Row], whole: str) -> list[Row]:
    return [r for r in rows.values() if r.get("whole") == whole]


def _lost(row: Row) -> float:
    return float(row["on"]["heldout_db"]) - float(row["auto"]["heldout_db"])


def _db(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def calibrated(rows: Sequence[Row], least: float) -> float | None:
    """The property's value at which the median gain is ``least``, between those measured; ``None`` outside of them."""
    by: dict[float, list[Row]] = {}
    for row in rows:
        by.setdefault(row["factor"], []).append(row)
    points = sorted(
        (float(np.median([r["value"] for r in own])), float(np.median([_gain(r) for r in own]))) for own in by.values()
    )
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        if y0 < least <= y1:
            return x0 + (x1 - x0) * (least - y0) / (y1 - y0)
    return None


EFFECTS = Effects()
