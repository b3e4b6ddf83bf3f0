"""Tables of the page on single parts: the fixer, the ground's constraint and completed façades."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean, median
from typing import Any

from docs.result_tables import claims as claims_of
from docs.result_tables import result, short_log, table

_DASH = "–"


def fixer_claims() -> str:
    """Claims on the fixer, over the views of all logs."""
    return claims_of("fixer")


def fixer_logs() -> str:
    """Renders and fixed views at 3 m, log by log, and where the ground is not held."""
    lines = []
    for row in result("fixer")["rows"]:
        seconds = f"{median(row['time']['seconds']) / row['time']['views']:.2f}"
        # A log without a true image has kernel distances instead, which are a table of their own.
        held = _before_and_after(row["truth"]) if "truth" in row else [_DASH] * 4
        lines.append([short_log(row), "held", *held, _flicker(row["flicker"]), seconds])
        if "loose" in row:
            # Flicker and seconds are measured on scenes whose ground is held.
            lines.append([short_log(row), "not held", *_before_and_after(row["loose"]), _DASH, _DASH])
    head = [
        "log",
        "ground",
        "PSNR of renders, dB",
        "of fixed views",
        "perceptual distance of renders",
        "of fixed views",
        "flicker, fixed over render",
        "seconds a view",
    ]
    return table(head, lines)


def _flicker(found: Mapping[str, float]) -> str:
    """Flicker of fixed views over that of renders, and that of true images where there are any."""
    fixed = f"{found['fixed'] / found['render']:.2f}"
    return f"{fixed} (true: {found['truth'] / found['render']:.2f})" if "truth" in found else fixed


def _before_and_after(scores: Mapping[str, Any]) -> list[str]:
    """Means over views of PSNR, then of perceptual distance, each of renders and of fixed views."""
    digits = {"psnr": 2, "perceptual": 3}
    return [f"{fmean(scores[kind][key]):.{digits[key]}f}" for key in digits for kind in ("render", "fixed")]


def fixer_shifts() -> str:
    """How far views that FNet fixes are from the truth, by their distance from the path."""
    gates = [gate for row in result("fixer")["rows"] for gate in row.get("gate", [])]
    lines = []
    for shift in sorted({gate["shift"] for gate in gates}):
        here = [gate for gate in gates if gate["shift"] == shift]
        render = [x for gate in here for x in gate["render"]]
        fixed = [x for gate in here for x in gate["fixed"]]
        worst = max(after / before - 1 for before, after in zip(render, fixed, strict=True))
        lines.append(
            [f"{shift:g}", str(len(render)), f"{fmean(render):.3f}", f"{fmean(fixed):.3f}", f"{100 * worst:+.1f} %"]
        )
    return table(["metres", "views", "perceptual distance of renders", "of fixed views", "worst view"], lines)


def fixer_real() -> str:
    """Kernel distances of renders and fixed views of the real log to its recorded images."""
    lines = []
    for row in result("fixer")["rows"]:
        for shift, found in row.get("kernel", {}).items():
            fixed = found["render"] + found["difference"]
            interval = f"{found['difference']:+.3f} ({found['low']:+.3f} to {found['high']:+.3f})"
            lines.append([short_log(row), shift, f"{found['render']:.3f}", f"{fixed:.3f}", interval])
    head = ["log", "metres", "kernel distance of renders", "of fixed views", "difference, 95 % interval"]
    return table(head, lines)


def ground() -> str:
    """GNet with and without the ground's constraint, log by log, then claims."""
    return _switch("ground")


def facades() -> str:
    """GNet with and without completed façades, log by log, then claims."""
    return _switch("facades")


def _switch(name: str) -> str:
    lines = []
    for row in result(name)["rows"]:
        for kind in ("without", "with"):
            found = row[kind]
            lines.append([short_log(row), kind, *_numbers([*found["initial"], *found["gnet"]])])
    head = [
        "log",
        "with it or without",
        "initial scene: held-out PSNR, dB",
        "at 3 m",
        "GNet: held-out PSNR, dB",
        "at 3 m",
    ]
    return table(head, lines) + "\n" + claims_of(name)


def _numbers(values: Sequence[float | None]) -> list[str]:
    # The real log has no true image beside its path.
    return [_DASH if value is None else f"{value:.2f}" for value in values]
