"""A finished run of two tiny chunks, for tests of simulations: made once, by the first three stages."""

from __future__ import annotations

from pathlib import Path

from flows.configuration import load_configuration
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.run_records import FinishedRun, summarise_run, write_run_record

LOG = "synthetic:street?seed=900&frames=12&cameras=2&width=64&height=36&lidar_beams=32&lidar_azimuths=300&samples=1"
SETTINGS = (
    "ingest.width_px=64",
    "ingest.height_px=36",
    "ingest.chunk_frames=6",
    "initial.max_points=600",
    "initial.distant_count=100",
)
CHUNKS = (0, 1)


def make_run(store: Path, log: str = LOG, settings: tuple[str, ...] = ()) -> str:
    """Ingests two chunks and makes their initial scenes; the run's name."""
    config = load_configuration("demo", settings=(*SETTINGS, *settings)).model_dump(mode="json")
    chunks: dict[int, dict[str, ArtifactRef]] = {}
    for chunk in CHUNKS:
        refs: dict[str, ArtifactRef] = {}
        for stage in ("ingest", "effects", "initial"):
            refs[stage] = run_stage(stage, Job(log, chunk, str(store), config), refs)
        chunks[chunk] = refs
    run = FinishedRun(log=log, preset="demo", store=str(store), config=config, differs={}, chunks=chunks)
    return str(write_run_record(run, summarise_run(run), {})["run"])
