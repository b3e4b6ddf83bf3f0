"""Finished runs: their summary, their record beside the artifacts, and how to get a stage's value back."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, run_id
from flows.reconstruction.run_summary import ChunkSummary, RunSummary, StageSummary
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError
from storage.address import Address
from storage.local import open_store

if TYPE_CHECKING:
    from genre_tasks.scene.graph import SceneGraph
    from storage.local import Artifact

_FOLDER = "runs"
SCENES = ("initial", "gnet", "enet")
"""The stages that make a scene, in their order."""


@dataclass(frozen=True)
class Run:
    """A finished run: what was asked for, and the references of every stage of every chunk.

    ``notes``, by chunk, are shown with it: what it was made with, where that is not what was asked for.
    """

    log: str
    preset: str
    store: str
    config: dict[str, Any]
    differs: dict[str, tuple[Any, Any]]
    chunks: dict[int, dict[str, ArtifactRef]]
    notes: Mapping[int, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The same for runs that made (or found) the same artifacts."""
        keys = {f"{c}/{s}": ref.key for c, refs in self.chunks.items() for s, ref in refs.items()}
        return run_id(self.log, self.preset, keys)

    @property
    def folder(self) -> Path:
        return open_store(self.store).root / _FOLDER / self.name


def finish_run(run: Run, summary: RunSummary, more: Mapping[str, Any]) -> dict[str, Any]:
    """Writes the run's record, ``more`` in it, and its report into the store; returns the record."""
    from flows.reconstruction.report import write_report

    run.folder.mkdir(parents=True, exist_ok=True)
    report = write_report(run.folder / "report.html", summary)
    record = {
        "log": run.log,
        "preset": run.preset,
        "store": run.store,
        "run": run.name,
        "report": str(report),
        "config": run.config,
        "differs": {key: list(values) for key, values in run.differs.items()},
        "chunks": [
            {
                "chunk": chunk.chunk,
                "warnings": list(chunk.warnings),
                "stages": [
                    {
                        "stage": s.stage,
                        "key": s.key,
                        "cached": s.cached,
                        "seconds": s.seconds,
                        "peak_mib": s.peak_mib,
                        "metrics": s.metrics,
                    }
                    for s in chunk.stages
                ],
            }
            for chunk in summary.chunks
        ],
        **more,
    }
    with atomic_path(run.folder / "run.json") as part:
        part.write_text(json.dumps(record, indent=1))
    return record


def summary_of(run: Run) -> RunSummary:
    """What the report and the tables show, read from the store's manifests and evaluation artifacts."""
    chunks = tuple(_chunk_summary(run, chunk, refs) for chunk, refs in sorted(run.chunks.items()))
    return RunSummary(run=run.name, log=run.log, preset=run.preset, store=run.store, chunks=chunks, differs=run.differs)


def _chunk_summary(run: Run, chunk: int, refs: dict[str, ArtifactRef]) -> ChunkSummary:
    store = open_store(run.store)
    found = {name: _found(run.store, ref) for name, ref in refs.items()}
    stages = []
    for spec in (s for s in PIPELINE if s.name in found):
        manifest = found[spec.name].manifest
        metrics: dict[str, float] = {}
        pictures: dict[str, bytes] = {}
        intervals: dict[str, tuple[float, float]] = {}
        curve: tuple[tuple[float, float], ...] = ()
        if f"evaluate/{spec.name}" in found:
            evaluation = store.read(found[f"evaluate/{spec.name}"])
            metrics = _with_counts(evaluation.metrics)
            intervals = {
                m.name: (m.low, m.high) for m in evaluation.metrics if m.low is not None and m.high is not None
            }
            pictures = {name: _png(image) for name, image in evaluation.pictures.items()}
            curve = _against_seconds(evaluation.curve, manifest.measurements.get("seconds_per_iteration", ()))
        stages.append(
            StageSummary(
                stage=spec.name,
                key=manifest.key,
                cached=refs[spec.name].cached,
                seconds=manifest.seconds,
                peak_mib=manifest.peak_mib,
                metrics=metrics,
                pictures=pictures,
                curve=curve,
                warnings=manifest.warnings,
                intervals=intervals,
            )
        )
    notes = (run.notes[chunk],) if chunk in run.notes else ()
    return ChunkSummary(chunk=chunk, stages=tuple(stages), warnings=(*notes, *_marks(found["ingest"])))


def _with_counts(metrics: Any) -> dict[str, float]:
    """Metric values by name, and for each group of them the number of images as ``…/n``."""
    out = {m.name: m.value for m in metrics}
    return out | {m.name.rpartition("/")[0] + "/n": float(m.n) for m in metrics}


def _marks(ingested: Artifact) -> tuple[str, ...]:
    marks = ingested.manifest.measurements.get("marks", ())
    return tuple(str(m) for m in marks)


def _against_seconds(curve: Any, seconds: Any) -> tuple[tuple[float, float], ...]:
    spent = [0.0, *itertools.accumulate(seconds)]
    return tuple((spent[iteration], psnr) for iteration, psnr in curve if iteration < len(spent))


def _png(image: Any) -> bytes:
    import io

    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, format="PNG")
    return out.getvalue()


def _found(store: str, ref: ArtifactRef) -> Artifact:
    opened = open_store(store)
    parts = Path(ref.path).relative_to(opened.root).parts
    address = Address(parts[0], parts[1], int(parts[2]), "/".join(parts[3:-1]), parts[-1])
    artifact = opened.find(address)
    if artifact is None:
        raise InputError("an artifact of this run is gone", remedy="Run the log again.", file=ref.path, stage=ref.stage)
    return artifact


def recorded_runs(store: str) -> list[dict[str, Any]]:
    """The records of all finished runs of a store, oldest first."""
    paths = sorted((open_store(store).root / _FOLDER).glob("*/run.json"), key=lambda p: p.stat().st_mtime)
    return [json.loads(path.read_text()) for path in paths]


def _record(store: str, run: str) -> dict[str, Any]:
    found = [r for r in recorded_runs(store) if r["run"].startswith(run)]
    if len(found) != 1:
        raise InputError(
            f"{len(found)} runs of this store begin with '{run}'", remedy="`genre show runs` lists them.", file=store
        )
    return found[0]


def stage_value(store: str, run: str, chunk: int | None, stage: str) -> tuple[int, Any]:
    """The chunk's number and the value of one of its stages, for a run named by (the start of) its name."""
    record = _record(store, run)
    chunks = {c["chunk"]: c["stages"] for c in record["chunks"]}
    number = min(chunks) if chunk is None else chunk
    if number not in chunks:
        raise InputError(f"the run has no chunk {number}", remedy=f"It has {sorted(chunks)}.", log=record["log"])
    keys = {s["stage"]: s["key"] for s in chunks[number]}
    if stage not in keys:
        raise InputError(f"the run has no stage '{stage}'", remedy=f"It has {', '.join(keys)}.", stage=stage)
    opened = open_store(store)
    for artifact in opened.artifacts(key=keys[stage]):
        return number, opened.read(artifact)
    raise InputError("the artifact is gone", remedy="Run the log again.", log=record["log"], stage=stage)


def stage_scene(store: str, run: str, chunk: int, stage: str) -> SceneGraph:
    """The scene that a stage has made. Raises ``InputError`` for a stage that makes none."""
    if stage not in SCENES:
        raise InputError(f"the stage {stage} makes no scene", remedy=f"Those do: {', '.join(SCENES)}.", stage=stage)
    scene: SceneGraph = stage_value(store, run, chunk, stage)[1].scene
    return scene


def last_stage(store: str, run: str, chunk: int) -> str:
    """The stage whose scene is the result of a run's chunk: enet, or gnet where nothing was distilled."""
    record = _record(store, run)
    stages = {s["stage"] for c in record["chunks"] if c["chunk"] == chunk for s in c["stages"]}
    return next(name for name in reversed(SCENES) if name in stages)


def next_scene(store: str, run: str, chunk: int, stage: str | None) -> tuple[Any, Any] | None:
    """The chunk after ``chunk`` and its scene after ``stage`` (its last one without it), where the run has both."""
    chunks = {c["chunk"] for c in _record(store, run)["chunks"]}
    if chunk + 1 not in chunks:
        return None
    name = stage or last_stage(store, run, chunk + 1)
    return stage_value(store, run, chunk + 1, "ingest")[1], stage_scene(store, run, chunk + 1, name)
