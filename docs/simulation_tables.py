"""Tables of re-simulation for the documents, from the JSON file that ``genre bench simulation`` writes."""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from docs.result_tables import number, provenance, result, table

NAME = "simulation"
BEHAVIOURS = ("brake", "accelerate", "lane_change", "swerve")
METHODS = {"genre+": "GenRe+", "difix": "Difix3D-style", "3dgs": "3DGS"}
METRICS = {
    "psnr": "PSNR to the truth, dB ↑",
    "perceptual": "perceptual distance to the truth ↓",
    "kernel": "kernel distance to real images ↓",
}
COMPARISON = re.compile(r"simulation\.(psnr|perceptual|kernel)_(\w+)_vs_(\w+)")
CLAIM_WORDS = {
    "simulation.removal_psnr": "PSNR where a removed actor was and another frame saw what is behind, median actor",
    "simulation.removal_psnr_worst": "the same, worst actor",
    "simulation.removal_outside": "Largest change of a pixel outside of a removed actor and its shadow",
    "simulation.insertion_turned": "PSNR that an inserted actor gains by being turned as the truth is, median actor",
    "simulation.round_trip": "Fraction of actors that are the same bytes after a move there and back",
    "simulation.flicker": "Flicker of ENet's scene over that of the truth, median rollout",
    "simulation.handover_step": "Largest step between images at a hand-over, over that within chunks",
    "simulation.speed_small": "Images a second, three cameras of 320×180, rendered and encoded",
    "simulation.speed_large": "Images a second, three cameras of 1280×720, rendered and encoded",
    "simulation.memory": "Growth of memory over 2,000 poses",
    "simulation.lidar_range": "Median range error of LiDAR within 40 m, held-out sweeps",
    "simulation.lidar_recall": "Fraction of recorded returns within 40 m whose ray hits something",
    "simulation.plausible": "Fraction of 1,000 random behaviours that stay within the bounds, of those planned",
    "simulation.clear_errors": "Fraction of impossible requests that give one clear error",
}


def behaviours() -> str:
    """Every method along every behaviour: mean over logs, streets against the truth and the real log as a set.

    The last rows say how far beside the path rollouts start, and count those that overlap a road user.
    """
    rows = [row for row in result(NAME)["rows"] if row["cell"].startswith("behaviours") and "rollouts" in row]
    streets = [row for row in rows if "differences" not in row]
    real = [row for row in rows if "differences" in row]
    lines = []
    for metric, words in METRICS.items():
        for label in METHODS.values():
            logs = real if metric == "kernel" else streets
            means = [_mean(logs, behaviour.replace("_", "-"), label, metric) for behaviour in BEHAVIOURS]
            lines.append([words, label, *means])
    for logs, words in ((streets, "streets"), (real, "the real log")):
        lines.append([f"starts of rollouts on {words}", "all", *(_starts(logs, behaviour) for behaviour in BEHAVIOURS)])
        lines.append([f"rollouts on {words} that overlap a road user", "all", *_overlaps(logs)])
    head = ["metric", "method", *(behaviour.replace("_", " ") for behaviour in BEHAVIOURS)]
    return table(head, lines)


def _starts(rows: Sequence[dict[str, Any]], behaviour: str) -> str:
    """Counts the rollouts of a behaviour by how far beside the recorded path they start."""
    starts = {
        (row["log"], entry["start_offset_m"])
        for row in rows
        for entry in row["rollouts"]
        if entry["behaviour"] == behaviour.replace("_", "-")
    }
    counts = Counter(abs(start_m) for _, start_m in starts)
    return ", ".join(f"{counts[start_m]} at {start_m:g} m" for start_m in sorted(counts, reverse=True)) or "–"


def _overlaps(rows: Sequence[dict[str, Any]]) -> list[str]:
    # Imported here: the other tables do without what the benchmark imports.
    from benchmarks.simulation.behaviour_quality import count_overlaps

    counts = [count_overlaps(rows, behaviour.replace("_", "-")) for behaviour in BEHAVIOURS]
    return [f"{overlapping} of {total}" if total else "–" for overlapping, total in counts]


def _mean(rows: Sequence[dict[str, Any]], behaviour: str, method: str, metric: str) -> str:
    by_log = []
    for row in rows:
        values = [
            entry["metrics"][metric]
            for entry in row["rollouts"]
            if entry["behaviour"] == behaviour and entry["method"] == method and metric in entry["metrics"]
        ]
        if values:
            by_log.append(sum(values) / len(values))
    if not by_log:
        return "–"
    mean = sum(by_log) / len(by_log)
    return f"{mean:.2f}" if metric == "psnr" else f"{mean:.3f}"


def removal() -> str:
    """What removed actors hid, as rendered and as filled by FNet: PSNR of the median actor."""
    actors = [
        actor
        for row in result(NAME)["rows"]
        if row["cell"].startswith("removal") and "actors" in row
        for actor in row["actors"]
    ]
    areas = {"recorded": "another frame saw it", "never_recorded": "no frame saw it"}
    lines = []
    for version, words in (("rendered", "the scene without the actor"), ("filled", "filled by FNet, as written")):
        values = [_median_psnr(actors, version, area) for area in areas]
        lines.append([words, *values])
    return table(["PSNR of what a removed actor hid, dB ↑", *areas.values()], lines)


def _median_psnr(actors: Sequence[dict[str, Any]], version: str, area: str) -> str:
    values = []
    for actor in actors:
        error = sum(view[version][area]["squared_error"] for view in actor["views"])
        pixels = sum(view[version][area]["pixels"] for view in actor["views"])
        if pixels:
            values.append(-10 * math.log10(error / pixels))
    return f"{statistics.median(values):.1f}"


def comparison_claims() -> str:
    """The claims that compare methods: the end of the paired interval that is nearest to 0, for each behaviour."""
    claims = {claim["id"]: claim for claim in result(NAME)["claims"]}
    lines = []
    for metric, words in METRICS.items():
        for other in ("3dgs", "difix"):
            found = [claims[f"simulation.{metric}_{behaviour}_vs_{other}"] for behaviour in BEHAVIOURS]
            bounds = ["not measured" if c["measured"] is None else f"{c['measured']:+.3f}" for c in found]
            held = sum(c["holds"] for c in found)
            verdict = "yes" if held == len(found) else f"**{held} of {len(found)}**"
            verdict = "–" if all(c["measured"] is None for c in found) else verdict
            lines.append([words, METHODS[other], *bounds, f"{found[0]['op']} 0", verdict])
    head = ["metric", "GenRe+ less", *(behaviour.replace("_", " ") for behaviour in BEHAVIOURS), "target", "holds"]
    return table(head, lines)


def claims() -> str:
    """The other claims: target, measured number, and whether it holds."""
    lines = []
    for claim in result(NAME)["claims"]:
        if COMPARISON.fullmatch(claim["id"]):
            continue
        measured = "not measured" if claim["measured"] is None else number(claim["measured"])
        unit = claim["unit"] if claim["unit"] in ("dB", "m", "images/s", "of 255") else ""
        target = f"{claim['op']} {claim['target']:g} {unit}".strip()
        # A number that nobody took neither holds nor misses.
        verdict = "–" if claim["measured"] is None else "yes" if claim["holds"] else "**missed**"
        lines.append([CLAIM_WORDS[claim["id"]], target, measured, str(claim["n"]), verdict])
    return table(["claim", "target", "measured", "n", "holds"], lines) + "\n" + provenance(NAME)
