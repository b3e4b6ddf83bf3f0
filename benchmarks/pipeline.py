"""The main job's claims, measured: claim seeds of the synthetic street and chunk 1 of the real sequence.

genre bench main_job --json docs/benchmarks/main_job.json [--set seeds=1001,1002] [--set store=DIR]

Each log goes through the pipeline (preset ``small``) without Prefect, from and into a store: a broken-off log goes on
where it stopped. The tuned-Adam baseline has the same initial scene, renderer, loss and number of view renders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.bench import Bench, Cell, NotMeasuredError, Row
from benchmarks.common.claims import Claim, Op, claim
from benchmarks.common.run_stages import SETTINGS, metrics_of, reconstruct, seconds_of
from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE, stage_weights
from flows.pipeline.stage_runner import Job

SECONDS = 300.0
"""Predicted for one chunk, with evaluation and the baseline."""


def measure(log: str, chunk: int, store: str) -> Row:
    """One row: metrics per stage, seconds per stage, and tuned Adam's metrics."""
    reader, _, path = log.partition(":")
    if reader == "pandaset" and not Path(path).is_dir():
        raise NotMeasuredError(f"there is no folder {path}; give it with --set pandaset=PATH")
    values = load_configuration("small", settings=SETTINGS).model_dump(mode="json")
    job = Job(log, chunk, store, values)
    refs = reconstruct(job)
    adam_values = values | {"gnet": values["gnet"] | {"method": "adam"}}
    adam_job = Job(log, chunk, store, adam_values)
    adam = reconstruct(adam_job, ("ingest", "effects", "initial", "gnet", "evaluate/gnet"))
    names = ("initial", "gnet", "fnet", "enet")
    stages = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")
    return {
        "log": log,
        "chunk": chunk,
        "metrics": {name: metrics_of(job, refs[f"evaluate/{name}"]) for name in names}
        | {"adam": metrics_of(adam_job, adam["evaluate/gnet"])},
        "seconds": {name: seconds_of(job, refs[name])[0] for name in stages}
        | {"adam": seconds_of(job, adam["gnet"])[0]},
        "peak_mib": {name: seconds_of(job, refs[name])[1] for name in stages},
    }


@dataclass(frozen=True)
class Requirement:
    """A number of one row, and what it has to be."""

    id: str
    number: Callable[[Row], float]
    op: Op
    target: float
    unit: str


def _gain(metric: str, stage: str, before: str) -> Callable[[Row], float]:
    return lambda row: float(row["metrics"][stage][metric] - row["metrics"][before][metric])


def _repair(row: Row) -> float:
    fixed = row["metrics"]["fnet"]
    return float(fixed["shift_3m/psnr"] - fixed["shift_3m/render_psnr"])


def _perceptual_repair(row: Row) -> float:
    fixed = row["metrics"]["fnet"]
    return float(fixed["shift_3m/perceptual"] / fixed["shift_3m/render_perceptual"])


def _perceptual_enhancement(row: Row) -> float:
    m = row["metrics"]
    return float(m["enet"]["shift_3m/perceptual"] / m["gnet"]["shift_3m/perceptual"])


def _minutes(row: Row) -> float:
    return float(sum(seconds for name, seconds in row["seconds"].items() if name != "adam") / 60)


_PSNR = "interpolation/psnr"
_EVERYWHERE = (
    Requirement("main.gnet_over_initial_db", _gain(_PSNR, "gnet", "initial"), ">=", 4.0, "dB"),
    Requirement("main.gnet_vs_adam_db", _gain(_PSNR, "gnet", "adam"), ">=", 0.0, "dB"),
    Requirement("main.enet_interpolation_db", _gain(_PSNR, "enet", "gnet"), ">=", -0.5, "dB"),
    Requirement("main.minutes_per_chunk", _minutes, "<", 15.0, "min"),
)
_REAL = (Requirement("main.enet_kernel_3m", _gain("shift_3m/kernel", "enet", "gnet"), "<", 0.0, "kernel distance"),)
_WITH_TRUTH = (
    Requirement("main.fnet_psnr_3m_db", _repair, ">", 0.0, "dB"),
    Requirement("main.fnet_perceptual_3m", _perceptual_repair, "<", 1.0, "ratio"),
    Requirement("main.enet_perceptual_3m", _perceptual_enhancement, "<", 1.0, "ratio"),
)
"""Only the synthetic street has a true image 3 m beside the path."""


_STAGES = (("initial", "initial"), ("adam", "tuned Adam"), ("gnet", "GNet"), ("fnet", "FNet"), ("enet", "ENet"))
_COLUMNS = {
    "held-out PSNR": "interpolation/psnr",
    "SSIM": "interpolation/ssim",
    "perceptual": "interpolation/perceptual",
    "PSNR @3m": "shift_3m/psnr",
    "perceptual @3m": "shift_3m/perceptual",
    "kernel @3m": "shift_3m/kernel",
}


class MainJob:
    """One cell per log and chunk."""

    name = "main_job"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
    }
    code: tuple[str, ...] = (
        "benchmarks.pipeline",
        *(spec.module for spec in PIPELINE),
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """The seeds, then the real chunk; ``quick`` takes the first seed and the real chunk."""
        seeds = [seed for seed in options["seeds"].split(",") if seed][: 1 if quick else None]
        logs = [(f"synthetic:street?seed={seed}", 0) for seed in seeds] + [(f"pandaset:{options['pandaset']}", 1)]
        config = load_configuration("small", settings=SETTINGS)
        weights = [stage_weights(spec, config) for spec in PIPELINE]
        parameters = {"configuration": config.model_dump(mode="json"), "weights": weights}
        return [
            Cell(f"{log} chunk {chunk}", SECONDS, partial(measure, log, chunk, options["store"]), parameters)
            for log, chunk in logs
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """What each row says about each requirement."""
        for cell, row in rows.items():
            for r in _EVERYWHERE + (_WITH_TRUTH if cell.startswith("synthetic:") else _REAL):
                number = None if "not_measured" in row else r.number(row)
                yield claim(r.id, number, r.op, r.target, r.unit, cell.split("/")[-1])

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """The table that the README shows."""
        return markdown([row for row in rows.values() if "not_measured" not in row])


def markdown(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The rows as the table that the README shows."""
    yield "| log | stage | seconds | " + " | ".join(_COLUMNS) + " |"
    yield "|---|---|---|" + "---|" * len(_COLUMNS)
    for row in rows:
        for stage, name in _STAGES:
            found = row["metrics"][stage]
            cells = [f"{found[m]:.3f}" if m in found else "" for m in _COLUMNS.values()]
            log = f"{row['log'].split('/')[-1].removeprefix('synthetic:')} chunk {row['chunk']}"
            yield f"| {log} | {name} | {row['seconds'][stage]:.1f} | " + " | ".join(cells) + " |"
        fixed = row["metrics"]["fnet"]
        given = [f"{fixed[key]:.3f}" if (key := m.replace("/", "/render_")) in fixed else "" for m in _COLUMNS.values()]
        yield "| | the renders FNet was given | | " + " | ".join(given) + " |"


BENCH: Bench = MainJob()
