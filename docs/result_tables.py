"""Tables of measurements for the documents, from the JSON files that ``genre bench`` writes."""

from __future__ import annotations

import json
import re
import shlex
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from docs.claim_words import CLAIM_WORDS

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs/results/data"


def result(name: str) -> dict[str, Any]:
    """The JSON of one benchmark, as ``genre bench NAME --json`` wrote it."""
    loaded: dict[str, Any] = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    return loaded


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table.

    Args:
        head: titles of the columns.
        rows: cells of each row, as many as titles.
    """
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """A number with three significant digits or two decimals, whichever is shorter to read.

    >>> number(212.29), number(1.6807), number(0.0214), number(-0.0822)
    ('212', '1.68', '0.021', '-0.082')
    """
    size = abs(value)
    if size >= 100:
        return f"{value:.0f}"
    return f"{value:.2f}" if size >= 1 or size == 0 else f"{value:.3f}"


def provenance(name: str) -> str:
    """One line that says what a table was measured on, and how to measure it again."""
    loaded = result(name)
    rows = loaded["rows"]
    # A row that was measured elsewhere, or before, carries its own machine and commit.
    earlier = sum("commit" in row or "machine" in row for row in rows)
    part = (
        f" {earlier} of {len(rows)} rows are of earlier commits or other machines, which the file names."
        if earlier
        else ""
    )
    return f"Measured on {loaded['machine']} at commit `{loaded['commit'][:12]}` by {_command(name, loaded)}.{part}\n"


def _command(name: str, loaded: Mapping[str, Any]) -> str:
    """The command that measured a file, with options that were not the defaults, where the file notes them."""
    noted = loaded.get("options", {})
    # A row that was measured with other options than the last ones carries its own.
    settings = Counter(_settings(row.get("options", noted)) for row in loaded["rows"])
    command = f"genre bench {name} --json docs/results/data/{name}.json"
    if len(settings) == 1:
        return f"`{command}{next(iter(settings))}`"
    parts = [f"`{text.strip()}` for {count}" for text, count in settings.items() if text]
    return f"`{command}`, with {', '.join(parts)} of {len(loaded['rows'])} rows" if parts else f"`{command}`"


def _settings(options: Mapping[str, str]) -> str:
    return "".join(f" --set {shlex.quote(f'{key}={value}')}" for key, value in options.items())


_UNITS_WITHOUT_WORD = ("share", "ratio", "share of runs", "part", "distance")
"""Units that a claim's words say already."""


def claims(name: str, several: str = "logs") -> str:
    """Every claim of a benchmark: target, measured number, and whether it holds. Claims of one id share a row.

    Args:
        name: of the benchmark.
        several: what the claims of one id are of.
    """
    grouped: dict[str, list[dict[str, Any]]] = {}
    for claim in result(name)["claims"]:
        grouped.setdefault(claim["id"], []).append(claim)
    rows = []
    for claim_id, found in grouped.items():
        measured = [c["measured"] for c in found if c["measured"] is not None]
        values = ", ".join(number(m) for m in measured) or "not measured"
        held = sum(c["holds"] for c in found)
        verdict = "yes" if held == len(found) else "**missed**" if held == 0 else f"**{held} of {len(found)}**"
        # A number that nobody took neither holds nor misses.
        verdict = verdict if measured else "–"
        unit = found[0]["unit"]
        unit = "" if unit in _UNITS_WITHOUT_WORD else unit
        runs = ", ".join(str(c["n"]) for c in found) if len(found) == 1 else f"{len(found)} {several}"
        target = f"{found[0]['op']} {found[0]['target']:g} {unit}".strip()
        rows.append([CLAIM_WORDS[claim_id], target, values, runs, verdict])
    return table(["claim", "target", "measured", "n", "holds"], rows) + "\n" + provenance(name)


_READERS = {"pandaset": "PandaSet", "kitti": "KITTI"}


def short_log(row: Mapping[str, Any]) -> str:
    """``street 1001`` or ``PandaSet 002, chunk 1``."""
    seed = re.search(r"seed=(\d+)", row["log"])
    if seed:
        return f"street {seed[1]}"
    reader, _, path = row["log"].partition(":")
    folder = path.partition("?")[0].rstrip("/").rsplit("/", 1)[-1]
    return f"{_READERS.get(reader, reader)} {folder}, chunk {row['chunk']}"


METHODS = {
    "initial": "initial scene from LiDAR",
    "street_gs": "per-scene 3DGS, 1,000 iterations, actors in 3D boxes",
    "tuned_adam": "tuned Adam in GNet's place, preset `small`",
    "tuned_adam_split": "tuned Adam on split Gaussians in GNet's place, preset `small`",
    "small_gnet": "GNet, preset `small`",
    "small_enet": "GenRe, preset `small`",
    "fine_gnet": "GNet, preset `fine`",
    "fine_enet": "GenRe, preset `fine`",
}
"""The rows of the table at a glance, in order: key in the JSON → words."""


def glance() -> str:
    """Results at a glance: a row a method; streets as a mean, the real chunk by itself."""
    rows = result("pipeline")["rows"]
    streets = [r for r in rows if r["log"].startswith("synthetic")]
    real = [r for r in rows if not r["log"].startswith("synthetic")]

    def mean(found: Sequence[Mapping[str, Any]], method: str, metric: str, digits: int) -> str:
        values = [r["methods"][method]["metrics"].get(metric) for r in found]
        known = [v for v in values if v is not None]
        return f"{statistics.fmean(known):.{digits}f}" if known and len(known) == len(found) else "–"

    lines = []
    for method, words in METHODS.items():
        seconds = [r["methods"][method]["cpu_seconds"] for r in rows]
        lines.append(
            [
                words,
                mean(real, method, "interpolation/psnr", 2),
                mean(real, method, "shift_3m/kernel", 3),
                mean(streets, method, "interpolation/psnr", 2),
                mean(streets, method, "shift_3m/psnr", 2),
                mean(streets, method, "shift_3m/perceptual", 3),
                f"{statistics.median(seconds):.0f}",
            ]
        )
    head = [
        "method",
        "real: held-out PSNR, dB ↑",
        "real: kernel distance at 3 m ↓",
        "streets: held-out PSNR, dB ↑",
        "streets: PSNR at 3 m, dB ↑",
        "streets: perceptual distance at 3 m ↓",
        "CPU seconds a chunk ↓",
    ]
    return table(head, lines)


def pipeline_stages() -> str:
    """Metrics after each stage, a row a log and stage."""
    columns = {
        "held-out PSNR": "interpolation/psnr",
        "SSIM": "interpolation/ssim",
        "perceptual": "interpolation/perceptual",
        "PSNR at 3 m": "shift_3m/psnr",
        "perceptual at 3 m": "shift_3m/perceptual",
        "kernel at 3 m": "shift_3m/kernel",
    }
    lines = []
    for row in result("pipeline")["rows"]:
        for method, found in row["methods"].items():
            metrics = found["metrics"]
            cells = [f"{metrics[key]:.3f}" if key in metrics else "–" for key in columns.values()]
            lines.append([short_log(row), METHODS.get(method, METHOD_WORDS.get(method, method)), *cells])
    return table(["log", "after", *columns], lines)


METHOD_WORDS = {
    "small_fnet": "FNet's images, preset `small`",
    "fine_fnet": "FNet's images, preset `fine`",
}


def pipeline_seconds() -> str:
    """Seconds and peak memory of every stage, median over logs, for both presets."""
    stages = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")
    lines = []
    for preset in ("small", "fine"):
        for kind, words in (("seconds", "wall"), ("cpu_seconds", "CPU")):
            rows = [r[kind][preset] for r in result("pipeline")["rows"]]
            cells = [statistics.median(row[stage] for row in rows) for stage in stages]
            lines.append([f"`{preset}`, {words}", *(f"{c:.1f}" for c in cells), f"{sum(cells):.0f}"])
        memory = [
            statistics.median(r["peak_mib"][preset][stage] for r in result("pipeline")["rows"]) for stage in stages
        ]
        lines.append([f"`{preset}`, peak memory, MiB", *(f"{m:.0f}" for m in memory), f"{max(memory):.0f}"])
    return table(["seconds or MiB", *stages, "all"], lines)


def preset_choice() -> str:
    """Both presets on validation logs, by which the default was chosen."""
    columns = {
        "held-out PSNR, dB ↑": ("interpolation/psnr", 2),
        "held-out perceptual distance ↓": ("interpolation/perceptual", 3),
        "kernel distance at 3 m ↓": ("shift_3m/kernel", 3),
        "PSNR at 3 m, dB ↑": ("shift_3m/psnr", 2),
        "perceptual distance at 3 m ↓": ("shift_3m/perceptual", 3),
    }
    lines = []
    for row in result("preset_choice")["rows"]:
        for preset in ("small", "fine"):
            found = row["methods"][f"{preset}_enet"]
            metrics = found["metrics"]
            cells = [f"{metrics[k]:.{digits}f}" if k in metrics else "–" for k, digits in columns.values()]
            lines.append([short_log(row), f"`{preset}`", *cells, f"{found['cpu_seconds']:.0f}"])
    loaded = result("preset_choice")
    origin = f"Measured on {loaded['machine']} at commit `{loaded['commit'][:12]}`.\n"
    return table(["validation log", "preset", *columns, "CPU seconds ↓"], lines) + "\n" + origin


def raster_times() -> str:
    """Milliseconds of the renderer beside gsplat's torch reference."""
    lines = []
    for row in result("raster")["rows"]:
        if not row["cell"].startswith(("scene/", "peer/")) or "milliseconds" not in row:
            continue
        for name, found in row["milliseconds"].items():
            spread = f"{number(found['low'])}–{number(found['high'])}"
            lines.append([row["cell"].split("/")[1], name, number(found["median"]), spread, str(found["n"])])
    return table(["Gaussians", "what, threads", "median, ms", "quartiles, ms", "n"], lines)


RASTER_MACHINES = ("raster", "raster_xeon")
"""Results of ``genre bench raster`` on different machines; the first one's are the page's."""


def raster_machines() -> str:
    """The renderer's claims on each machine, and how fast each multiplies matrices and copies memory."""
    found = [result(name) for name in RASTER_MACHINES]
    claims_by_id = [{claim["id"]: claim for claim in each["claims"]} for each in found]
    lines = []
    for claim_id, first in claims_by_id[0].items():
        measured = [number(claims[claim_id]["measured"]) for claims in claims_by_id]
        lines.append([CLAIM_WORDS[claim_id], f"{first['op']} {first['target']:g}", *measured])
    scenes = [next(row for row in each["rows"] if row["cell"] == "scene/300k") for each in found]
    # What a machine can do at best says why its renderer is slower or faster.
    for key, words in (("gemm_gflop_s", "matrix product, GFLOP/s"), ("copy_gb_s", "copy, GB/s")):
        for threads in ("1", "2"):
            measured = [number(scene[key][threads]["median"]) for scene in scenes]
            lines.append([f"{words}, threads: {threads}", "–", *measured])
    machines = [f"{each['machine'].split(',')[0]}, `{each['commit'][:12]}`" for each in found]
    return table(["what", "target", *machines], lines)


def budget_runs() -> str:
    """Every budget that was tried: seconds used, and what was made of them."""
    lines = []
    for row in result("evaluation")["rows"]:
        if "multiple" in row:
            multiple = f"{row['multiple']:g}"
            used = f"{row['used_s']:.1f}"
            ratio = f"{row['used_s'] / row['budget_s']:.2f}"
            chosen = row["choices"][-1]["point"].replace("_", " ")
            lines.append([short_log(row), multiple, f"{row['budget_s']:.0f}", used, ratio, chosen, row["end"]])
    head = ["log", "budget over shortest run", "budget, s", "used, s", "used over budget", "setting", "last stage"]
    return table(head, lines)


LOG_TABLES = (
    "The race",
    "How far it goes",
    "Distillation by tuned Adam",
    "Distillation by the 3DGS recipe",
    "Enhancement: GNet → ENet",
)


def optimiser_logs() -> str:
    """Tables of the optimiser's benchmark, log by log."""
    from benchmarks.optimiser import per_log_tables

    rows = {row["cell"]: row for row in result("optimiser")["rows"]}
    tables = "\n".join(per_log_tables.pages(rows)).strip().split("\n\n")
    return "\n".join(f"### {title}\n\n{text}\n" for title, text in zip(LOG_TABLES, tables, strict=True))


def log_faults() -> str:
    """Every fault: the strengths that are found on each log, in brackets those that are not."""
    rows = [row for row in result("log_faults")["rows"] if row.get("fault", "none") != "none"]
    logs = list(dict.fromkeys(row["name"] for row in rows))
    lines = []
    for fault in dict.fromkeys(row["fault"] for row in rows):
        by_log = {row["name"]: row for row in rows if row["fault"] == fault}
        words = [word for row in by_log.values() for found in row["found"] for word in found]
        ranked = sorted(dict.fromkeys(words), key=words.count, reverse=True)[:3]
        unit = next(iter(by_log.values()))["unit"]
        title = f"{fault}, {unit}" if unit else fault
        cells = [_found_strengths(by_log[log]) if log in by_log else "–" for log in logs]
        lines.append([title, *cells, ", ".join(f"`{word}`" for word in ranked)])
    head = ["fault", *(_log_title(log) for log in logs), "named as"]
    return table(head, lines) + "\n" + provenance("log_faults")


def _log_title(name: str) -> str:
    """A log's name for the head of a table."""
    return (
        name.replace("seed=", "street ").replace("002", "PandaSet 002").replace("2011_09_26_drive_0009_sync", "KITTI")
    )


def _found_strengths(row: Mapping[str, Any]) -> str:
    if not row["unit"]:
        return "found" if row["found"][0] else "(not found)"
    pairs = zip(row["strengths"], row["found"], strict=True)
    return ", ".join(f"{strength:g}" if found else f"({strength:g})" for strength, found in pairs)
