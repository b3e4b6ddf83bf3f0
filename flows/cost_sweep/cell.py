"""One cell of a sweep: a setting on a chunk with a seed, from the store's stages as far as they are there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flows.configuration import load_configuration
from flows.cost_sweep.evaluation_plan import take_ego_pixels
from flows.cost_sweep.knobs import PRESET_ITSELF, RESOLUTION, Setting
from flows.experiments.log_chunks import LogChunk
from flows.experiments.stage_prediction import StagePredictor
from flows.experiments.stages import StageRunner, image_counts, metric_values, read_stage_costs, run_stages
from flows.experiments.warm_up import run_on_tiny_log
from flows.machine.facts import describe_environment
from flows.pipeline.definition import STAGE_BY_NAME, stages_until
from flows.pipeline.stage_runner import ArtifactRef, Job, artifact_address, read_artifact, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.temporary_names import temporary_folder
from genre_tasks.threads import torch_threads
from storage.code_digest import code_digest
from storage.keys import stage_key
from storage.opening import is_remote, open_store
from storage.store import Provenance


@dataclass(frozen=True)
class Cell:
    """What one cell measures: where, with which seed, and how.

    Attributes:
        where: the chunk.
        seed: orders the views of GNet and ENet, and draws the fixer's noise.
        setting: the preset with a knob turned.
    """

    where: LogChunk
    seed: int
    setting: Setting

    @property
    def name(self) -> str:
        """Names the cell for the user.

        >>> Cell(LogChunk("synthetic:street?seed=1001", 0), 2, Setting("views", "6")).name
        'views=6 · synthetic:street?seed=1001 chunk 0 · seed 2'
        """
        return f"{self.setting.name} · {self.where} · seed {self.seed}"


@dataclass(frozen=True)
class Sweep:
    """What all cells share.

    Attributes:
        preset: name of the preset.
        settings: the user's ``section.key=value`` over it.
        store: folder of the store.
    """

    preset: str
    settings: tuple[str, ...]
    store: str

    def job(self, cell: Cell) -> Job:
        """Builds the job of a cell.

        A number of threads has a store of its own: payloads and keys do not depend on it, so a shared store would
        give the seconds of whichever number ran first.
        """
        config = cell.setting.configuration(self.preset, self.settings, cell.seed)
        threads = cell.setting.threads
        # A shared store would hand a cell the seconds of another number of threads.
        store = _name_threads_store(self.store, threads) if threads else self.store
        return Job(cell.where.log, cell.where.chunk, store, config.model_dump(mode="json"))

    def reference_job(self, cell: Cell) -> Job:
        """Builds the job of the preset itself, whose images every setting is compared with.

        Args:
            cell: its chunk, seed and number of threads are kept.
        """
        return self.job(Cell(cell.where, cell.seed, Setting(PRESET_ITSELF, "", threads=cell.setting.threads)))


def _name_threads_store(store: str, threads: int) -> str:
    """Names the store of a number of threads.

    >>> _name_threads_store("stores/main/", 2), _name_threads_store("s3://bucket", 2)
    ('stores/main-threads-2', 's3://bucket/.threads-2')
    """
    place = store.rstrip("/")
    # Beside a bucket is another bucket, which may be anyone's. Hidden, as a store passes over such folders: it would
    # take the artifacts of a store within it for its own that were moved.
    return f"{place}/.threads-{threads}" if is_remote(store) else f"{place}-threads-{threads}"


def list_cells(places: Sequence[LogChunk], seeds: Sequence[int], settings: Sequence[Setting]) -> list[Cell]:
    """Lists every setting on every chunk with every seed.

    Args:
        places: the chunks.
        seeds: see :class:`Cell`.
        settings: the preset itself first, then the others.

    Returns:
        One seed of one chunk after the other, so that a sweep that is stopped early is a sweep of fewer seeds.
    """
    # Seeds are the outermost loop: a sweep that is stopped early is then a complete sweep of fewer seeds.
    return [Cell(where, seed, setting) for seed in seeds for where in places for setting in settings]


def run_cell(sweep: Sweep, cell: Cell, runner: StageRunner) -> dict[str, Any] | None:
    """Measures a cell.

    A scene is compared with the images at the preset's resolution, whatever it was reconstructed from. Poses and gains
    are those that it was reconstructed with.

    Args:
        sweep: what all cells share.
        cell: what to measure.
        runner: runs one stage.

    Returns:
        A row: seconds, CPU seconds and memory of the stages, number of Gaussians, and the metrics of the end's scene.
        ``None`` for an effect that the plan sets as the cell would, or that the log makes impossible, and for larger
        images than the log's that ingest leaves at the preset's size.

    Raises:
        GenreError: as the stages raise it.
    """
    # A cell that equals the preset would show the noise of timing as a gain.
    if cell.setting.effect is not None and not _changes_the_plan(sweep, cell, runner):
        return None
    if cell.setting.knob == RESOLUTION and not _changes_the_images(sweep, cell, runner):
        return None
    job = sweep.job(cell)
    # The end belongs to the setting, because some knobs leave out ENet altogether.
    end = cell.setting.end
    # 0 threads stand for those that there are.
    with torch_threads(cell.setting.threads or None):
        refs = run_stages(stages_until(end), job, runner)
        evaluation = runner(f"evaluate/{end}", job, _evaluation_inputs(sweep, cell, refs, runner))
    # The evaluation is not among these stages: it is no cost of a reconstruction.
    costs = read_stage_costs(job, refs)
    metrics = read_artifact(job, evaluation).metrics
    return {
        "knob": cell.setting.knob,
        "value": cell.setting.value,
        "setting": cell.setting.name,
        "changes": list(cell.setting.changes),
        "end": end,
        "threads": cell.setting.threads,
        "log": cell.where.log,
        "chunk": cell.where.chunk,
        "seed": cell.seed,
        "images": len(read_artifact(job, refs["ingest"]).views),
        "seconds": costs.seconds,
        "cpu_seconds": costs.cpu_seconds,
        "peak_mib": costs.peak_mib,
        "gaussians": len(read_artifact(job, refs[end]).scene),
        "metrics": metric_values(metrics) | image_counts(metrics),
    }


def _evaluation_inputs(
    sweep: Sweep, cell: Cell, refs: dict[str, ArtifactRef], runner: StageRunner
) -> dict[str, ArtifactRef]:
    # Every setting is compared at the preset's resolution, else fewer pixels would look like better quality.
    inputs = {name: refs[name] for name in STAGE_BY_NAME[f"evaluate/{cell.setting.end}"].inputs}
    reference = sweep.reference_job(cell)
    ingest = runner("ingest", reference, {})
    # Images of another size: a mask of the recording vehicle has to be of their pixels, and poses stay the scene's.
    if ingest.key != refs["ingest"].key:
        planned = runner("effects", reference, {"ingest": ingest})
        inputs["ingest"] = ingest
        inputs["effects"] = _commit_evaluation_plan(reference, refs["effects"], planned)
    return inputs


def _commit_evaluation_plan(reference: Job, plan: ArtifactRef, planned: ArtifactRef) -> ArtifactRef:
    """Stores a cell's plan with the reference's ego mask, which is of the pixels that are compared."""
    value = take_ego_pixels(read_artifact(reference, plan), read_artifact(reference, planned))
    code = code_digest(take_ego_pixels.__module__)
    # No input is called `ingest`, by which predictions find the artifacts whose seconds are those of a stage.
    key = stage_key("effects", code, {}, {"plan": plan.payload_digest, "ego_pixels": planned.payload_digest})
    provenance = Provenance(
        inputs={"plan": plan.key, "ego_pixels": planned.key}, code_digest=code, environment=describe_environment()
    )
    address = artifact_address("effects", reference, key)
    # A sound one stays, and a damaged one is replaced.
    artifact = open_store(reference.store).commit(address, "effects", value, provenance)
    return ArtifactRef("effects", key, artifact.manifest.payload_digest, address, cached=False)


def _changes_the_plan(sweep: Sweep, cell: Cell, runner: StageRunner) -> bool:
    """Tells whether the chunk's plan sets the cell's effect otherwise, and whether it can be set at all."""
    reference = sweep.reference_job(cell)
    refs = run_stages(("ingest", "effects"), reference, runner)
    decision = read_artifact(reference, refs["effects"])[cell.setting.effect]
    # Off without a measured value means that the log lacks what the effect needs.
    impossible = decision.choice == "off" and math.isnan(decision.value)
    return decision.choice != cell.setting.effect_state and not impossible


def _changes_the_images(sweep: Sweep, cell: Cell, runner: StageRunner) -> bool:
    """Tells whether the cell's images have another size than the preset's; none is enlarged beyond the log's own."""
    sizes = []
    for job in (sweep.job(cell), sweep.reference_job(cell)):
        chunk = read_artifact(job, runner("ingest", job, {}))
        sizes.append([(view.lens.width_px, view.lens.height_px) for view in chunk.views])
    return sizes[0] != sizes[1]


def predict_cells(sweep: Sweep, cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Predicts what cells would take, without running any.

    Args:
        sweep: what all cells share.
        cells: in the order in which they would run.

    Returns:
        A row for each cell, see :meth:`flows.experiments.stage_prediction.StagePredictor.predict`.
    """
    predictor = StagePredictor(sweep.store)
    rows = []
    for cell in cells:
        # Usual seconds are those of the preset, from which the prediction scales to the cell.
        base = PipelineConfig.model_validate(sweep.reference_job(cell).config)
        names = (*stages_until(cell.setting.end), f"evaluate/{cell.setting.end}")
        rows.append(predictor.predict(cell.name, sweep.job(cell), base, names))
    return rows


def read_logs_once(sweep: Sweep, cells: Sequence[Cell]) -> None:
    """Ingests each chunk once into a store that is deleted, so that no cell pays for a log's first reading.

    A synthetic street draws its images when they are first asked for, which takes longer than the rest of ingest.

    Args:
        sweep: what all cells share.
        cells: name the chunks.

    Raises:
        InputError: a log cannot be read.
    """
    config = load_configuration(sweep.preset, settings=sweep.settings).model_dump(mode="json")
    # Many cells share a chunk, and only the first reading of a log is slow.
    for where in dict.fromkeys(c.where for c in cells):
        with temporary_folder() as store:
            run_stage("ingest", Job(where.log, where.chunk, str(store), config), {})


def measure_cold_start(sweep: Sweep) -> dict[str, float]:
    """Measures what the first stage of each kind in a process takes beyond later ones: imports, weights, first calls.

    Args:
        sweep: its preset and settings are run on a tiny log, twice.

    Returns:
        By stage: the seconds of the first run less those of the second, at least 0. Afterwards the process is warm, so
        that a sweep's seconds hold none of it.
    """
    preset = Setting(PRESET_ITSELF, "")
    config = preset.configuration(sweep.preset, sweep.settings, seed=0)
    stages = stages_until(preset.end)
    names = (*stages, f"evaluate/{preset.end}")
    # The difference of two runs cancels the work itself, which a single first run would count as start-up.
    first = run_on_tiny_log(config, names)
    second = run_on_tiny_log(config, names)
    # Noise can make the second run the slower one, but a negative start-up would make no sense.
    return {stage: max(0.0, first[stage] - second[stage]) for stage in stages}
