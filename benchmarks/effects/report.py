"""The claims and tables that the rows of the effects' benchmark make."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from benchmarks.common.bench import Row, list_not_measured
from benchmarks.common.claims import Claim, Op
from benchmarks.common.context import cell_label
from benchmarks.common.over_cells import claim_over_cells
from benchmarks.effects.cases import CASES

BENCH_NAME = "effects"
LEAST_GAIN = {"dB": 0.5, "%": 20.0}
"""What an effect has to gain on a street made for four times its threshold, by the unit of its measure.

A street may reach less, as its cameras and surfaces have bounds, or more, where no parameter sets the property."""
MOST_LOSS = {"dB": 0.1, "%": 2.0}
"""What leaving an effect out of a street that does not call for it may lose; its threshold is where it gains that."""


def effect_gain(row: Row) -> float:
    """Computes what enabling an effect brings.

    Args:
        row: see :func:`benchmarks.effects.cells.measure_effect`.

    Returns:
        dB, or per cent of what remains without the effect.

    >>> effect_gain({"on": {"measure": 26.5}, "off": {"measure": 26.0}, "unit": "dB"})
    0.5
    """
    on = float(row["on"]["measure"])
    off = float(row["off"]["measure"])
    # Decibels are a ratio already; other units are compared with what remains without the effect.
    return on - off if row["unit"] == "dB" else 100 * (on - off) / abs(off)


def make_claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Claims what each effect gains on streets made for it, what is lost on plain ones, and two claims of whole plans.

    Args:
        rows: by cell.
    """
    kinds: tuple[tuple[float, str, Op, dict[str, float]], ...] = (
        (4.0, "gain", ">=", LEAST_GAIN),
        (0.0, "loss", "<", MOST_LOSS),
    )
    for name, case in CASES.items():
        for factor, kind, op, targets in kinds:
            if kind == "loss" and case.plain is None:
                continue
            # Other factors serve to place thresholds and are part of no claim.
            found = [r for r in _effect_rows(rows, name) if r["factor"] == factor]
            gains = [effect_gain(r) for r in found]
            data = f"on less off; {', '.join(r['log'] for r in found) or 'not measured'}"
            yield claim_over_cells(
                f"{kind}_{name}", gains, op, targets[case.unit], case.unit, data=data, bench=BENCH_NAME
            )
    costs = [r["cost_percent"]["planned"] for r in _full_plan_rows(rows, "plain_cost")]
    data = "instructions of a street without actors, given its plan, over one that was not planned"
    yield claim_over_cells("plain_cost", costs, "<=", 2.0, "%", data=data, bench=BENCH_NAME)
    losses = [_auto_loss_db(r) for r in _full_plan_rows(rows, "auto_vs_on")]
    data = "held out, all effects set on less as planned, of streets that have every effect"
    yield claim_over_cells("auto_vs_on", losses, "<=", 0.2, "dB", data=data, bench=BENCH_NAME)


def make_table(rows: Mapping[str, Row]) -> Iterator[str]:
    """Gives a line for each effect and log, and a paragraph for each whole plan and each threshold.

    Args:
        rows: by cell.
    """
    views = "held out: with | without | at 3 m: with | without"
    yield f"| effect | log | measured | plan | with | without | gain | {views} | GNet, s: with | without |"
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    for row in _effect_rows(rows):
        yield _effect_line(row)
    for r in _full_plan_rows(rows, "auto_vs_on"):
        auto = _format_db(r["auto"]["heldout_db"])
        on = _format_db(r["on"]["heldout_db"])
        yield f"\n{r['log']}: held out {auto} as planned, {on} all on"
    for r in _full_plan_rows(rows, "plain_cost"):
        planned = r["cost_percent"]["planned"]
        planning = r["cost_percent"]["planning"]
        yield f"\n{r['log']}: {planned:+.2f} % instructions with the plan given, {planning:+.2f} % with making it"
    for r in _full_plan_rows(rows, "trained"):
        variants = ", ".join(_trained_variant(name, r[name]) for name in ("shipped", "plain", "effects"))
        yield f"\n{r['log']} chunk {r['chunk']}: held out and at 3 m: {variants}"
    for name, case in CASES.items():
        found = [r for r in _effect_rows(rows, name) if r["factor"] > 0 and r["value"] is not None]
        least = MOST_LOSS[case.unit]
        value = find_threshold(found, least)
        if value is not None:
            yield f"\n{name}: enabling gains {least:g} {case.unit} at {value:.3g} {found[0]['property_unit']}"
    yield from list_not_measured(rows)


def find_threshold(rows: Sequence[Row], least: float) -> float | None:
    """Finds the value of a property from which on enabling an effect pays.

    Args:
        rows: of one effect at several factors.
        least: the gain that counts as paying.

    Returns:
        The value at which the median gain is ``least``, interpolated between measured ones; ``None`` outside of them.
    """
    by_factor: dict[float, list[Row]] = {}
    for row in rows:
        by_factor.setdefault(row["factor"], []).append(row)
    points = sorted(
        # The median over streets, because the same factor gives each street another value.
        (float(np.median([r["value"] for r in part])), float(np.median([effect_gain(r) for r in part])))
        for part in by_factor.values()
    )
    for (value, gain), (next_value, next_gain) in itertools.pairwise(points):
        # The first crossing upwards; outside of the measured range nothing is extrapolated.
        if gain < least <= next_gain:
            return value + (next_value - value) * (least - gain) / (next_gain - gain)
    return None


def _effect_line(row: Row) -> str:
    value = "" if row["value"] is None else f"{row['value']:.3g} {row['property_unit']} (> {row['threshold']:g})"
    views = " | ".join(_format_db(row[s][key]) for key in ("heldout_db", "beside_db") for s in ("on", "off"))
    measures = f"{abs(row['on']['measure']):.2f} | {abs(row['off']['measure']):.2f}"
    gain = f"{effect_gain(row):+.2f} {row['unit']}"
    seconds = f"{row['on']['gnet_s']:.2f} | {row['off']['gnet_s']:.2f}"
    columns = (row["effect"], cell_label(row), value, row["choice"], measures, gain, views, seconds)
    return f"| {' | '.join(columns)} |"


def _trained_variant(name: str, scores: Row) -> str:
    return f"{name} {_format_db(scores['measure'])} and {_format_db(scores['beside_db']) or 'unknown'}"


def _effect_rows(rows: Mapping[str, Row], name: str | None = None) -> list[Row]:
    return [r for r in rows.values() if "effect" in r and name in (None, r["effect"])]


def _full_plan_rows(rows: Mapping[str, Row], kind: str) -> list[Row]:
    return [r for r in rows.values() if r.get("whole") == kind]


def _auto_loss_db(row: Row) -> float:
    return float(row["on"]["heldout_db"]) - float(row["auto"]["heldout_db"])


def _format_db(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
