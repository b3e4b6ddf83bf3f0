"""One cell of a sweep: a setting on a chunk with a seed, from the store's stages as far as they are there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from flows.cost_sweep.knobs import PRESET_ITSELF, Setting
from flows.pipeline.definition import BY_NAME, PIPELINE, reconstructing_until
from flows.pipeline.stage_runner import ArtifactRef, Job, artifact_of, value_of

Produce = Callable[[str, Job, dict[str, ArtifactRef]], ArtifactRef]


@dataclass(frozen=True)
class Cell:
    """Where, with which seed, and how."""

    log: str
    chunk: int
    seed: int
    setting: Setting

    @property
    def name(self) -> str:
        return f"{self.setting.name} · {self.log} chunk {self.chunk} · seed {self.seed}"


@dataclass(frozen=True)
class Sweep:
    """What all cells share: the preset, the user's settings over it, what is judged, and the store."""

    preset: str
    settings: tuple[str, ...]
    store: str

    def job(self, cell: Cell) -> Job:
        """Other numbers of threads have a store of their own: their payloads, and so their keys, are the same."""
        values = cell.setting.configuration(self.preset, self.settings, cell.seed).model_dump(mode="json")
        threads = cell.setting.threads
        return Job(cell.log, cell.chunk, f"{self.store}-threads-{threads}" if threads else self.store, values)

    def judge(self, cell: Cell) -> Job:
        """The job of the preset itself, whose images are those that every setting is judged by."""
        return self.job(Cell(cell.log, cell.chunk, cell.seed, Setting(PRESET_ITSELF, "", threads=cell.setting.threads)))


def stages_of(setting: Setting) -> tuple[str, ...]:
    """The reconstructing stages up to the setting's end."""
    return reconstructing_until(setting.end)


def run_cell(sweep: Sweep, cell: Cell, produce: Produce) -> dict[str, Any] | None:
    """A row: seconds, CPU seconds and memory of each stage, Gaussians, and the metrics of the end's scene.

    A scene is judged by the images at the preset's resolution, whatever it was reconstructed from. ``None`` for an
    effect that the plan has as the cell would set it, or that the log makes impossible.
    """
    job = sweep.job(cell)
    if cell.setting.effect is not None and not _differs(sweep, cell, produce):
        return None
    refs: dict[str, ArtifactRef] = {}
    with threads(cell.setting.threads):
        for spec in PIPELINE:
            if spec.name in stages_of(cell.setting):
                refs[spec.name] = produce(spec.name, job, {name: refs[name] for name in spec.inputs})
        judging = BY_NAME[f"evaluate/{cell.setting.end}"]
        judged = {name: refs[name] for name in judging.inputs}
        judge = sweep.judge(cell)
        shown = produce("ingest", judge, {})
        if shown.key != refs["ingest"].key:  # images of another size: what was fitted to pixels is the judge's too
            judged |= {"ingest": shown, "effects": produce("effects", judge, {"ingest": shown})}
        evaluation = produce(judging.name, job, judged)
    row: dict[str, Any] = {"knob": cell.setting.knob, "value": cell.setting.value, "setting": cell.setting.name}
    row |= {"changes": list(cell.setting.changes), "end": cell.setting.end, "threads": cell.setting.threads}
    row |= {"log": cell.log, "chunk": cell.chunk, "seed": cell.seed, "images": len(value_of(job, refs["ingest"]).views)}
    stages = {name: artifact_of(job, ref).manifest for name, ref in refs.items()}
    row["seconds"] = {name: m.seconds for name, m in stages.items()}
    row["cpu_seconds"] = {name: m.measurements.get("cpu_seconds") for name, m in stages.items()}
    row["peak_mib"] = max(m.peak_mib for m in stages.values())
    row["gaussians"] = len(value_of(job, refs[cell.setting.end]).scene)
    metrics = value_of(job, evaluation).metrics
    row["metrics"] = {m.name: m.value for m in metrics} | {m.name.rpartition("/")[0] + "/n": m.n for m in metrics}
    return row


def cells_of(places: Sequence[tuple[str, int]], seeds: Sequence[int], settings: Sequence[Setting]) -> list[Cell]:
    """Every setting everywhere with every seed: one seed of one place after the other, so that a part is a sweep."""
    return [Cell(log, chunk, seed, s) for seed in seeds for log, chunk in places for s in settings]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """``count`` threads of the CPU, or as they are for 0."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _differs(sweep: Sweep, cell: Cell, produce: Produce) -> bool:
    """Whether the cell's effect is one that its chunk's plan has otherwise, and that can be set at all."""
    judge = sweep.judge(cell)
    planned = produce("effects", judge, {"ingest": produce("ingest", judge, {})})
    decision = value_of(judge, planned)[cell.setting.effect]
    impossible = decision.choice == "off" and decision.value != decision.value
    return decision.choice != cell.setting.word and not impossible
