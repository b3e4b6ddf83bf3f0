"""Stages that run are observed: their log records, their counts, and the bytes that the store's manifests name."""

from __future__ import annotations

from pathlib import Path

import pytest
from prometheus_client import generate_latest

from flows.configuration import load_configuration
from flows.observability.exporter import make_registry
from flows.observability.process_counters import METRICS_FOLDER
from flows.observability.stage_context import get_stage_context
from flows.pipeline.stage_runner import ArtifactRef, Job, open_artifact, run_stage
from genre_tasks.errors import GenreError
from tests.faults.small_run import LOG, SETTINGS
from tests.observability.test_metrics import parse


def test_running_stages_counts_them_and_names_them_in_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(METRICS_FOLDER, str(tmp_path / "metrics"))
    config = load_configuration("demo", settings=SETTINGS).model_dump(mode="json")
    job = Job(LOG, 0, str(tmp_path / "store"), config)
    contexts = []

    def watch(done: int, total: int, note: str = "") -> None:
        contexts.append(get_stage_context())

    refs: dict[str, ArtifactRef] = {}
    for stage in ("ingest", "effects", "ingest"):
        refs[stage] = run_stage(stage, job, refs, progress=watch)
    assert get_stage_context() is None
    assert contexts
    first = contexts[0]
    assert first is not None
    assert (first.log, first.chunk, first.stage, first.key) == (LOG, 0, "ingest", refs["ingest"].key)
    with pytest.raises(GenreError):
        run_stage("ingest", Job("synthetic:nothing", 0, job.store, config), {}, attempt=2)
    found = parse(generate_latest(make_registry(tmp_path / "metrics")).decode())
    outcomes = {key[1:]: value for key, value in found.items() if key[0] == "genre_stages_total"}
    assert outcomes == {
        ("ingest", "computed"): 1,
        ("ingest", "cached"): 1,
        ("ingest", "failed"): 1,
        ("effects", "computed"): 1,
    }
    sizes = {name: sum(f.size for f in open_artifact(job, refs[name]).manifest.files) for name in refs}
    assert found[("genre_artifact_bytes_written_total", "ingest")] == sizes["ingest"]
    assert found[("genre_artifact_bytes_written_total", "effects")] == sizes["effects"]
    assert found[("genre_artifact_bytes_read_total", "effects")] == sizes["ingest"]
    assert ("genre_artifact_bytes_read_total", "ingest") not in found
    assert found[("genre_stage_retries_total", "ingest")] == 1
    assert found[("genre_running_stages", "ingest")] == 0
