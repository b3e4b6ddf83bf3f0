"""The pipeline's claims, measured: claim seeds of the synthetic street and chunk 1 of the real sequence.

genre bench pipeline --json docs/results/data/pipeline.json [--set seeds=1001,1002] [--set store=DIR]
genre bench pipeline --json docs/results/data/preset_choice.json --set seeds=900,901,902 --set real_chunk=0

The second command measures validation logs, by which the default preset was chosen.

Each log goes through the pipeline with the presets ``small`` and ``fine``, without Prefect, from and into a store, so
that a run that was stopped goes on. Tuned Adam takes the place of GNet in ``small``, with and without a split of
Gaussians. It has the same initial scene, renderer, loss, iterations and views an iteration, at rates that were swept
for that length (``configs/baselines.yaml``). GNet renders every source view once more, to choose what it splits.
Per-scene 3DGS with actors in their boxes is the plain fit that the pictures show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    logs_from_options,
    measured_rows,
    settings_from_options,
)
from benchmarks.common.claims import Claim, Op, claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.common.run_stages import SETTINGS, read_metrics, reconstruct, warm_up
from benchmarks.common.task import require_log_folder
from flows.configuration import load_configuration
from flows.paper_tables.baselines import load_baselines
from flows.pipeline.definition import PIPELINE, digest_stage_weights
from flows.pipeline.stage_runner import Job, open_artifact

CELL_S = 480.0
"""Predicted for one chunk: both presets with evaluation, and the baselines."""
PRESETS_MEASURED = ("small", "fine")
ADAM_VARIANTS = {"tuned_adam": "72x3", "tuned_adam_split": "72x3+50%"}
"""Baseline → its variant that has the iterations and views of GNet in ``small``."""
GNET_STAGES = ("ingest", "effects", "initial", "gnet", "evaluate/gnet")
EVALUATED = ("initial", "gnet", "fnet", "enet")
TIMED = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")


def configurations(per_scene_iterations: str, settings: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Configures every run of a log.

    Args:
        per_scene_iterations: length of per-scene 3DGS, as text.
        settings: ``section.key=value`` over all presets.

    Returns:
        Run → the pipeline's configuration as plain values: ``small``, ``fine``, ``tuned_adam``, ``tuned_adam_split``
        and ``street_gs``.
    """
    presets = {name: load_configuration(name, settings=(*SETTINGS, *settings)) for name in PRESETS_MEASURED}
    values = {name: config.model_dump(mode="json") for name, config in presets.items()}
    small = values["small"]
    per_scene = small["gnet"]["per_scene"] | {"iterations": int(per_scene_iterations)}
    baselines = load_baselines("small")
    adams = {name: baselines[name].variant(length).model_dump(mode="json") for name, length in ADAM_VARIANTS.items()}
    # The user's settings of iterations and views stay, so that Adam has as many as GNet in the smallest form too.
    own = ("method", "adam", "split_fraction")
    return values | {
        **{name: small | {"gnet": small["gnet"] | {key: adam[key] for key in own}} for name, adam in adams.items()},
        "street_gs": small | {"gnet": small["gnet"] | {"method": "street_gs", "per_scene": per_scene}},
    }


def measure(log: str, chunk: int, store: str, runs: Mapping[str, Mapping[str, Any]]) -> Row:
    """Measures one chunk.

    Args:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store that stages come from and go to.
        runs: see :func:`configurations`.

    Returns:
        A row. ``methods`` has metrics, and seconds from the log to that result, of each method; ``seconds``,
        ``cpu_seconds`` and ``peak_mib`` have those of each stage, by preset.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    require_log_folder(log)
    # Otherwise the first preset would pay for imports and weights that the others find loaded.
    warm_up(runs["small"], TIMED)
    row: Row = {"log": log, "chunk": chunk, "methods": {}, "seconds": {}, "cpu_seconds": {}, "peak_mib": {}}
    for name, values in runs.items():
        job = Job(log, chunk, store, dict(values))
        is_preset = name in PRESETS_MEASURED
        refs = reconstruct(job) if is_preset else reconstruct(job, GNET_STAGES)
        manifests = {stage: open_artifact(job, refs[stage]).manifest for stage in TIMED if stage in refs}
        seconds = {stage: manifest.seconds for stage, manifest in manifests.items()}
        cpu_seconds = {stage: manifest.measurements["cpu_seconds"] for stage, manifest in manifests.items()}
        for stage in EVALUATED:
            if f"evaluate/{stage}" not in refs or (stage == "initial" and name != "small"):
                continue
            method = "initial" if stage == "initial" else f"{name}_{stage}" if is_preset else name
            until = TIMED[: TIMED.index(stage) + 1]
            row["methods"][method] = {
                "metrics": read_metrics(job, refs[f"evaluate/{stage}"]),
                "seconds": sum(seconds[k] for k in until if k in seconds),
                "cpu_seconds": sum(cpu_seconds[k] for k in until if k in cpu_seconds),
            }
        if is_preset:
            row["seconds"][name] = seconds
            row["cpu_seconds"][name] = cpu_seconds
            row["peak_mib"][name] = {stage: manifest.peak_mib for stage, manifest in manifests.items()}
    return row


@dataclass(frozen=True)
class Requirement:
    """A number of one row, and what it has to be.

    Attributes:
        id: of the claim.
        number: reads the number off a row.
        op: how the number has to compare with the target.
        target: in ``unit``.
        unit: of the number.
    """

    id: str
    number: Callable[[Row], float]
    op: Op
    target: float
    unit: str


def _gain(metric: str, method: str, before: str) -> Callable[[Row], float]:
    return lambda row: _metrics(row, method)[metric] - _metrics(row, before)[metric]


def _metrics(row: Row, method: str) -> Mapping[str, float]:
    found: Mapping[str, float] = row["methods"][method]["metrics"]
    return found


def _fixer_gain_db(row: Row) -> float:
    fixed = _metrics(row, "small_fnet")
    return fixed["shift_3m/psnr"] - fixed["shift_3m/render_psnr"]


def _fixer_perceptual_ratio(row: Row) -> float:
    fixed = _metrics(row, "small_fnet")
    return fixed["shift_3m/perceptual"] / fixed["shift_3m/render_perceptual"]


def _enet_perceptual_ratio(row: Row) -> float:
    enhanced = _metrics(row, "small_enet")
    return enhanced["shift_3m/perceptual"] / _metrics(row, "small_gnet")["shift_3m/perceptual"]


def _minutes(row: Row) -> float:
    return float(sum(row["seconds"]["fine"].values()) / 60)


_PSNR = "interpolation/psnr"
_EVERYWHERE = (
    Requirement("main.gnet_over_initial_db", _gain(_PSNR, "small_gnet", "initial"), ">=", 4.0, unit="dB"),
    Requirement("main.gnet_vs_adam_db", _gain(_PSNR, "small_gnet", "tuned_adam"), ">=", 0.0, unit="dB"),
    Requirement("main.gnet_vs_adam_split_db", _gain(_PSNR, "small_gnet", "tuned_adam_split"), ">=", 0.0, unit="dB"),
    Requirement("main.enet_interpolation_db", _gain(_PSNR, "small_enet", "small_gnet"), ">=", -0.5, unit="dB"),
    Requirement("main.minutes_per_chunk", _minutes, "<", 15.0, unit="min"),
    Requirement("main.fine_heldout_db", _gain(_PSNR, "fine_enet", "small_enet"), ">", 0.0, unit="dB"),
    Requirement(
        "main.fine_kernel_3m", _gain("shift_3m/kernel", "fine_enet", "small_enet"), "<", 0.0, "kernel distance"
    ),
)
_REAL = (
    Requirement(
        "main.enet_kernel_3m", _gain("shift_3m/kernel", "small_enet", "small_gnet"), "<", 0.0, unit="kernel distance"
    ),
)
_WITH_TRUTH = (
    Requirement("main.fnet_psnr_3m_db", _fixer_gain_db, ">", 0.0, unit="dB"),
    Requirement("main.fnet_perceptual_3m", _fixer_perceptual_ratio, "<", 1.0, unit="ratio"),
    Requirement("main.enet_perceptual_3m", _enet_perceptual_ratio, "<", 1.0, unit="ratio"),
)
"""Only the synthetic street has a true image 3 m beside the path."""

_COLUMNS = {
    "held-out PSNR": "interpolation/psnr",
    "SSIM": "interpolation/ssim",
    "perceptual": "interpolation/perceptual",
    "PSNR @3m": "shift_3m/psnr",
    "perceptual @3m": "shift_3m/perceptual",
    "kernel @3m": "shift_3m/kernel",
}


class PipelineBench:
    """A cell for each log and chunk."""

    name = "pipeline"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        "real_chunk": "1",
        "settings": "",
        "per_scene_iterations": "1000",
    }
    code: tuple[str, ...] = (
        "benchmarks.pipeline",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {"seeds": TINY_STREET, "pandaset": "", "settings": TINY_SETTINGS, "per_scene_iterations": "20"}, "street"
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the seeds, then the real chunk; ``quick`` takes the first seed and the real chunk."""
        logs = logs_from_options(options)
        if quick:
            streets = [(log, chunk) for log, chunk in logs if log.startswith("synthetic:")]
            logs = [*streets[:1], *(place for place in logs if place not in streets)]
        settings = settings_from_options(options)
        runs = configurations(options["per_scene_iterations"], settings)
        config = load_configuration("small", settings=(*SETTINGS, *settings))
        weights = [digest_stage_weights(spec, config) for spec in PIPELINE]
        parameters = {"configurations": runs, "weights": weights}
        return [
            Cell(f"{log} chunk {chunk}", CELL_S, partial(measure, log, chunk, options["store"], runs), parameters)
            for log, chunk in logs
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes a claim of each row and requirement."""
        for cell, row in rows.items():
            for r in _EVERYWHERE + (_WITH_TRUTH if cell.startswith("synthetic:") else _REAL):
                number = None if "not_measured" in row else r.number(row)
                yield claim(r.id, number, r.op, r.target, r.unit, cell.split("/")[-1])

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a line for each log and method."""
        yield "| log | method | CPU seconds | " + " | ".join(_COLUMNS) + " |"
        yield "|---|---|---|" + "---|" * len(_COLUMNS)
        for row in measured_rows(rows):
            log = f"{row['log'].split('/')[-1].removeprefix('synthetic:')} chunk {row['chunk']}"
            for method, found in row["methods"].items():
                values = _format_metrics(found["metrics"], _COLUMNS.values())
                yield f"| {log} | {method} | {found['cpu_seconds']:.1f} | {values} |"


def _format_metrics(metrics: Mapping[str, float], keys: Iterable[str]) -> str:
    return " | ".join(f"{metrics[key]:.3f}" if key in metrics else "" for key in keys)


BENCH: Bench = PipelineBench()
