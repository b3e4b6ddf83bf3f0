"""The paper's image size on a CPU: seconds and memory of every stage of the preset hd, and what its images are worth.

genre bench full_size --json docs/results/data/full_size.json [--set judged=1] [--set store=DIR]

A run starts from an empty store, in a process of its own, and takes the stages in order as ``genre run`` does, without
evaluation. Images are judged in a store that stays, so that a measurement that was stopped goes on.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch
from torch.nn import functional

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
from benchmarks.common.claims import Claim, claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.common.run_stages import read_metrics, reconstruct
from benchmarks.common.task import require_log_folder
from flows.cli.parsing import parse_memory
from flows.configuration import load_configuration
from flows.machine.resource_usage import measure_usage
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from flows.pipeline.stage_runner import ArtifactRef, Job, open_artifact, read_artifact, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.metrics.scoring import ScoreCollector, decode_view_image
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.chunk import View
from genre_tasks.stages.evaluation_renders import render_batches

STAGES = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")
_RUN_S = 400.0
_LIMITED_RUN_S = 600.0
_QUALITY_S = 1800.0
_LIMIT_MINUTES = 6.0
_LIMIT_GIB = 6.0 * 1e9 / 2**30
_LIMIT_FNET_S = 2.0
_KERNEL_CUT = 0.25
_SHARPER = 0.20
_MEMORY_ERROR = 0.15
_NOT_MEASURED = "not measured"
_MEASURED = ("seconds", "cpu_seconds", "peak_gib", "predicted_gib")


class FullSize:
    """Seconds, memory and image quality of the preset ``hd``."""

    name = "full_size"
    options: Mapping[str, str] = {
        "log": "pandaset:../shared/data/pandaset/002",
        "chunks": "0",
        "judged": "1",
        "memory": "4GB",
        "settings": "",
        "store": "genre-store",
    }
    code: tuple[str, ...] = (
        "benchmarks.full_size",
        # How much memory a process takes is theirs to decide.
        "flows.pipeline.memory_plan",
        "flows.pipeline.stage_inputs",
        "flows.machine.memory_reuse",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm({"log": f"synthetic:street?seed={TINY_STREET}", "settings": TINY_SETTINGS}, only="run")

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the runs of ``chunks``, freely and with little ``memory``, and the images of ``judged``.

        ``quick`` leaves out all but the free runs.
        """
        settings = settings_from_options(options)
        log = options["log"]
        # A whole chunk for the time; for the images one that was never tuned on.
        timed = [int(number) for number in split_option(options["chunks"])]
        judged = [] if quick else [int(number) for number in split_option(options["judged"])]
        run = partial(measure_run, settings)
        judge = partial(measure_quality, settings, options["store"])
        cells = [Cell(f"run chunk {k}", _RUN_S, partial(run, log, k), describe(log, k, settings)) for k in timed]
        limit_gib = parse_memory(options["memory"], "memory")
        limited = (*settings, f"limits.memory_gib={limit_gib!r}")
        cells += [
            Cell(
                f"run chunk {k} in {options['memory']}",
                _LIMITED_RUN_S,
                partial(measure_run, limited, log, k),
                describe(log, k, limited),
            )
            for k in ([] if quick else timed)
        ]
        return cells + [
            Cell(f"quality chunk {k}", _QUALITY_S, partial(judge, log, k), describe(log, k, settings)) for k in judged
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims, chunk by chunk; those without a chunk say that they were not measured."""
        runs = [row for row in rows.values() if row.get("kind") == "run"]
        free: list[Row | None] = [row for row in runs if row["limit_gib"] is None]
        quality: list[Row | None] = [row for row in rows.values() if row.get("kind") == "quality"]
        # A limited run alone says nothing of bytes: it has nothing to be compared with.
        chunks = {row["chunk"]: row for row in runs if row["limit_gib"] is None}
        limited = [row for row in runs if row["limit_gib"] is not None and row["chunk"] in chunks]
        pairs: list[tuple[Row, Row] | None] = [(chunks[row["chunk"]], row) for row in limited]
        for row in free or [None]:
            yield from _run_claims(row)
        for row in quality or [None]:
            yield from _quality_claims(row)
        for pair in pairs or [None]:
            yield from _memory_claims(pair)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the table that the command prints."""
        yield "| chunk | limit, GiB | stage | seconds | CPU seconds | GiB | predicted |"
        yield "|---|---|---|---|---|---|---|"
        for row in rows.values():
            for stage, measured in row.get("stages", {}).items():
                numbers = " | ".join(f"{measured[name]:.1f}" for name in _MEASURED)
                yield f"| {row['chunk']} | {row['limit_gib'] or '–'} | {stage} | {numbers} |"


def describe(log: str, chunk: int, settings: tuple[str, ...]) -> dict[str, Any]:
    """Says what a cell depends on beyond the code, for the cells' cache.

    Args:
        log: URI.
        chunk: its number.
        settings: over the preset.
    """
    config = load_configuration("hd", settings=settings)
    weights = [digest_stage_weights(STAGE_BY_NAME[stage], config) for stage in ("gnet", "fnet", "enet")]
    return {"log": log, "chunk": chunk, "configuration": config.model_dump(mode="json"), "weights": weights}


def build_job(preset: str, log: str, chunk: int, store: str, settings: tuple[str, ...]) -> Job:
    """Builds the job of a preset.

    Args:
        preset: its name.
        log: URI.
        chunk: its number.
        store: folder of the store.
        settings: over the preset.
    """
    config: PipelineConfig = load_configuration(preset, settings=settings)
    return Job(log, chunk, store, config.model_dump(mode="json"))


def measure_run(settings: tuple[str, ...], log: str, chunk: int) -> Row:
    """Runs all stages from an empty store in a new process.

    Args:
        settings: over the preset.
        log: URI.
        chunk: its number.

    Returns:
        ``stages`` with seconds, CPU seconds, the largest memory while each ran and what was predicted; ``seconds`` and
        ``peak_gib`` of the whole; ``limit_gib`` that was set; views that were fixed, and Gaussians at the end.
    """
    require_log_folder(log)
    with tempfile.TemporaryDirectory() as folder:
        job = build_job("hd", log, chunk, folder, settings)
        # A new process: what this one has loaded and cached would count as the run's memory and save its seconds.
        with get_context("spawn").Pool(1) as pool:
            return pool.apply(_run_all, (job, torch.get_num_threads()))


def _run_all(job: Job, threads: int) -> Row:
    torch.set_num_threads(threads)
    stages = {}
    refs: dict[str, ArtifactRef] = {}
    began = time.perf_counter()
    for stage in STAGES:
        # Reading inputs and writing the artifact count, as a user's clock counts them.
        with measure_usage() as usage:
            refs[stage] = run_stage(stage, job, refs)
        manifest = open_artifact(job, refs[stage]).manifest
        stages[stage] = {
            "seconds": usage.seconds,
            "cpu_seconds": usage.cpu_seconds,
            "peak_gib": usage.peak_mib / 1024,
            "predicted_gib": manifest.measurements["predicted_mib"] / 1024,
            "payload_digest": manifest.payload_digest,
        }
    seconds = time.perf_counter() - began
    return {
        "kind": "run",
        "log": job.log,
        "chunk": job.chunk,
        "limit_gib": PipelineConfig.model_validate(job.config).limits.memory_gib,
        "stages": stages,
        "seconds": seconds,
        "peak_gib": max(stage["peak_gib"] for stage in stages.values()),
        "fixed_views": len(read_artifact(job, refs["fnet"]).views),
        "gaussians": len(read_artifact(job, refs["enet"]).scene),
    }


def measure_quality(settings: tuple[str, ...], store: str, log: str, chunk: int) -> Row:
    """Judges the images of GNet, FNet and ENet, and those of the preset ``small`` that are scaled up.

    Args:
        settings: over the presets.
        store: folder of the store.
        log: URI.
        chunk: its number.

    Returns:
        Metrics by stage, and the perceptual distance of held-out images of ``hd`` and of ``small`` scaled up.
    """
    require_log_folder(log)
    job = build_job("hd", log, chunk, store, settings)
    evaluated = ("gnet", "fnet", "enet")
    refs = reconstruct(job, (*STAGES, *(f"evaluate/{stage}" for stage in evaluated)))
    metrics = {stage: read_metrics(job, refs[f"evaluate/{stage}"]) for stage in evaluated}
    full = apply_plan(read_artifact(job, refs["ingest"]), read_artifact(job, refs["effects"]))
    small = build_job("small", log, chunk, store, settings)
    return {
        "kind": "quality",
        "log": log,
        "chunk": chunk,
        "metrics": metrics,
        "small_scaled_up": _judge_scaled_up(small, full.views_with_role("heldout")),
    }


def _judge_scaled_up(job: Job, views: tuple[View, ...]) -> float:
    """Perceptual distance of a smaller preset's held-out renders, scaled up to the views' size."""
    refs = reconstruct(job, STAGES)
    chunk = apply_plan(read_artifact(job, refs["ingest"]), read_artifact(job, refs["effects"]))
    scene = read_artifact(job, refs["enet"]).scene
    same = {(view.camera, view.frame): view for view in views}
    collector = ScoreCollector("enet", distributions=False)
    for batch, images in render_batches(scene, chunk.views_with_role("heldout"), RenderSettings(), None):
        for view, image in zip(batch, images, strict=True):
            target = same[view.camera, view.frame]
            size = (target.lens.height_px, target.lens.width_px)
            # The sharpest of the usual ways, so that the comparison is with a good enlargement.
            scaled = functional.interpolate(image.permute(2, 0, 1)[None], size, mode="bicubic", antialias=True)
            collector.add([target], scaled.clamp(0, 1).permute(0, 2, 3, 1), decode_view_image(target)[None])
    return sum(score.perceptual for score in collector.scores) / len(collector.scores)


def _memory_claims(pair: tuple[Row, Row] | None) -> Iterator[Claim]:
    if pair is None:
        limit_gib = parse_memory(FullSize.options["memory"], "memory") or 0.0
        yield claim("full_size.limited_gib", None, "<=", limit_gib, "GiB", _NOT_MEASURED)
        yield claim("full_size.memory_error", None, "<=", _MEMORY_ERROR, "share", _NOT_MEASURED)
        yield claim("full_size.changed_stages", None, "<=", 0, "stages", _NOT_MEASURED)
        return
    row = pair[1]
    where = f"{_place(row)}, freely and with at most {row['limit_gib']:.2f} GiB"
    stages = [stage for run in pair for stage in run["stages"].values()]
    largest = max(stages, key=lambda stage: abs(stage["peak_gib"] / stage["predicted_gib"] - 1))
    error = largest["peak_gib"] / largest["predicted_gib"] - 1
    # Digests of files and not of values: a stage that wrote other bytes would count.
    changed = [s for s in STAGES if len({run["stages"][s]["payload_digest"] for run in pair}) > 1]
    yield claim("full_size.limited_gib", row["peak_gib"], "<=", row["limit_gib"], "GiB", _place(row))
    yield claim("full_size.memory_error", abs(error), "<=", _MEMORY_ERROR, "share", f"{where}; of all stages")
    yield claim("full_size.changed_stages", len(changed), "<=", 0, "stages", where)


def _place(row: Row) -> str:
    return f"chunk {row['chunk']} of {row['log'].rpartition('/')[2]} with preset hd, without evaluation"


def _run_claims(row: Row | None) -> Iterator[Claim]:
    where = _NOT_MEASURED if row is None else _place(row)
    minutes = None if row is None else row["seconds"] / 60
    peak_gib = None if row is None else row["peak_gib"]
    fnet_s = None if row is None else row["stages"]["fnet"]["seconds"] / row["fixed_views"]
    yield claim("full_size.minutes", minutes, "<=", _LIMIT_MINUTES, "minutes", where)
    yield claim("full_size.peak_gib", peak_gib, "<=", _LIMIT_GIB, "GiB", where)
    yield claim("full_size.fnet_s", fnet_s, "<=", _LIMIT_FNET_S, "s", f"{where}, an image with reading and writing")


def _quality_claims(row: Row | None) -> Iterator[Claim]:
    where = _NOT_MEASURED
    cut = gain = sharper = None
    if row is not None:
        where = f"chunk {row['chunk']} of {row['log'].rpartition('/')[2]} with preset hd"
        gnet = row["metrics"]["gnet"]
        enet = row["metrics"]["enet"]
        cut = 1 - enet["shift_3m/kernel"] / gnet["shift_3m/kernel"]
        gain = enet["interpolation/psnr"] - gnet["interpolation/psnr"]
        sharper = 1 - enet["interpolation/perceptual"] / row["small_scaled_up"]
    yield claim("full_size.kernel_cut", cut, ">=", _KERNEL_CUT, "share", where)
    yield claim("full_size.heldout_gain", gain, ">=", 0.0, "dB", where)
    yield claim("full_size.perceptual_gain", sharper, ">=", _SHARPER, "share", where)


BENCH: Bench = FullSize()
