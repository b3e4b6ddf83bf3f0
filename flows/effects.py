"""The plan of a chunk's effects, without a run: ingest from the store, then what each effect measures."""

from __future__ import annotations

from pathlib import Path

from flows.logs import opened_log
from flows.produce import Job, produce
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.plan import plan
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.progress import Progress, silent
from storage.local import open_store


def effects_of(job: Job, progress: Progress = silent) -> EffectsPlan:
    """Ingests the chunk, or finds it ingested, and asks each effect that is not set off."""
    ref = produce("ingest", job, {}, progress=progress)
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=ref.key, chunk=job.chunk)
    config = PipelineConfig.model_validate(job.config).effects
    return plan(config, store.read(artifact), opened_log(job.log).cameras, progress)


def picture_of(effects: EffectsPlan, path: Path, title: str = "") -> None:
    """A bar an effect: its value in thresholds, on a logarithmic axis; what is called for in another colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = effects.decisions[::-1]
    figure = Figure(figsize=(8, 0.36 * len(rows) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    least = 0.01
    told = [d.value == d.value and d.threshold > 0 for d in rows]
    parts = [max(d.value / d.threshold, least) if known else least for d, known in zip(rows, told, strict=True)]
    wide = [part - least for part in parts]
    axes.barh(range(len(rows)), wide, left=least, color=["tab:grey" if d.choice == "off" else "tab:red" for d in rows])
    axes.axvline(1, color="black", linewidth=1)
    axes.set(xscale="log", xlim=(least, max(*parts, 10.0) * 30), title=title)
    axes.set_xlabel("value / threshold: right of the line it is called for")
    axes.set_yticks(range(len(rows)), [d.name.replace("_", " ") for d in rows])
    for k, (d, known) in enumerate(zip(rows, told, strict=True)):
        said = f"{d.value:.3g} {d.unit}" if known else d.reason
        axes.text(parts[k] * 1.2, k, f"{d.choice}: {said}", va="center", fontsize=7, backgroundcolor="white")
    temporary = path.with_name(f".{path.name}")
    figure.savefig(temporary, dpi=120, format="png")
    temporary.replace(path)
