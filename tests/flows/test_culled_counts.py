"""What was left out of the renders, and why, is in the stages' manifests and in ``genre show``."""

from __future__ import annotations

import re

import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from storage.opening import open_store
from tests.faults.small_run import LOG, SETTINGS


@pytest.fixture(scope="module")
def refs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict[str, ArtifactRef]]:
    store = str(tmp_path_factory.mktemp("culled") / "store")
    job = Job(LOG, 0, store, load_configuration("demo", settings=SETTINGS).model_dump(mode="json"))
    made: dict[str, ArtifactRef] = {}
    for stage in ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet"):
        made[stage] = run_stage(stage, job, {name: made[name] for name in STAGE_BY_NAME[stage].inputs})
    return store, made


@pytest.mark.parametrize(
    ("stage", "names"), [("gnet", ["culled"]), ("novel_views", ["culled", "lidar_culled"]), ("enet", ["culled"])]
)
def test_counts_by_reason(refs: tuple[str, dict[str, ArtifactRef]], stage: str, names: list[str]) -> None:
    store, made = refs
    opened = open_store(store)
    (artifact,) = opened.artifacts(key=made[stage].key)
    for name in names:
        counts = artifact.manifest.measurements[name]
        assert name == "lidar_culled" or counts["behind"] > 0
        assert set(counts) <= {"non_finite", "quaternion", "behind", "degenerate"}
        assert getattr(opened.read(artifact), name) == counts
    shown = CliRunner().invoke(app, ["show", made[stage].key, "--store", store])
    assert shown.exit_code == 0
    for name in names:
        counts = artifact.manifest.measurements[name]
        said = f"behind: {counts['behind']}" if counts else "none"
        assert re.search(rf"\b{name}:\W+{said}\b", shown.output), shown.output
