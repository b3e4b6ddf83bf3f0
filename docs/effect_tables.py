"""Tables of what each effect gains where it is called for and costs where it is not, from ``genre bench effects``."""

from __future__ import annotations

from statistics import median

from benchmarks.common.bench import Row
from benchmarks.effects.cases import CASES
from benchmarks.effects.report import effect_gain
from docs.claim_words import EFFECT_WORDS
from docs.result_tables import claims as claims_of
from docs.result_tables import number, provenance, result, short_log, table

_CALLED_FOR = 4.0
_NOT_CALLED_FOR = 0.0
_REAL_LOG = -1.0


def claims() -> str:
    """Claims on each effect, and on whole plans."""
    return claims_of("effects")


def on_streets() -> str:
    """What setting each effect on gains on streets that call for it, and on streets that do not."""
    lines = []
    for name in CASES:
        called = _rows(name, _CALLED_FOR)
        plain = _rows(name, _NOT_CALLED_FOR)
        # An effect that was not measured yet has no line.
        if not called or (not plain and CASES[name].plain is not None):
            continue
        first = called[0]
        # The plan's choice shows whether the threshold tells the two kinds of streets apart.
        planned = f"{sum(row['choice'] == 'on' for row in called)} of {len(called)}"
        planned_plain = f"{sum(row['choice'] == 'on' for row in plain)} of {len(plain)}" if plain else "–"
        gains_plain = _gains(plain) if plain else "–"
        threshold = f"{first['threshold']:g} {first['property_unit']}"
        over = _over_threshold(called)
        lines.append([EFFECT_WORDS[name], threshold, over, planned, _gains(called), planned_plain, gains_plain])
    head = [
        "effect",
        "set on above",
        "streets that call for it: measured over that",
        "planned on",
        "gain, median (least to most)",
        "streets that do not: planned on",
        "gain, median (least to most)",
    ]
    return table(head, lines) + "\n" + provenance("effects")


def on_real_chunks() -> str:
    """What the plan makes of the real chunks, and what each effect gains there."""
    lines = []
    for name in CASES:
        for row in _rows(name, _REAL_LOG):
            value = "–" if row["value"] is None else f"{row['value']:.3g} {row['property_unit']}"
            heldout = [f"{row[state]['heldout_db']:.2f}" for state in ("on", "off")]
            gain = f"{effect_gain(row):+.2f} {row['unit']}"
            lines.append([EFFECT_WORDS[name], short_log(row), value, row["choice"], gain, *heldout])
    head = ["effect", "chunk", "measured", "plan", "gain", "held-out PSNR with it, dB", "without it, dB"]
    return table(head, lines)


def whole_plans() -> str:
    """Held-out PSNR of streets that have every effect, as planned and with all set on."""
    rows = [row for row in result("effects")["rows"] if row.get("whole") == "auto_vs_on"]
    lines = [[short_log(row), *(f"{row[kind]['heldout_db']:.2f}" for kind in ("auto", "on"))] for row in rows]
    return table(["street with every effect", "as planned, dB", "all set on, dB"], lines) + "\n" + provenance("effects")


def _rows(name: str, factor: float) -> list[Row]:
    return [row for row in result("effects")["rows"] if row.get("effect") == name and row["factor"] == factor]


def _over_threshold(rows: list[Row]) -> str:
    """By which factors the plan measured the property above its threshold, least to most."""
    factors = [row["value"] / row["threshold"] for row in rows if row["value"] is not None]
    return f"{number(min(factors))} to {number(max(factors))}" if factors else "–"


def _gains(rows: list[Row]) -> str:
    gains = [effect_gain(row) for row in rows]
    return f"{median(gains):+.2f} {rows[0]['unit']} ({min(gains):+.2f} to {max(gains):+.2f})"
