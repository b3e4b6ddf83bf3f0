"""What stages are predicted to take: from the stages of a store that saw images of the same size, or typical values."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE
from flows.pipeline.prediction import median_stage_seconds, predict_run
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from storage.local import LocalStore
from tests.faults.small_run import LOG, SETTINGS

CONFIG = load_configuration("demo", settings=SETTINGS)
LARGE = load_configuration("demo", settings=[*SETTINGS, "ingest.width_px=1280", "ingest.height_px=720"])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The first stages of a run with small images."""
    folder = str(tmp_path_factory.mktemp("prediction") / "store")
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE[:3]:
        refs[spec.name] = run_stage(spec.name, Job(LOG, 0, folder, CONFIG.model_dump(mode="json")), refs)
    return folder


def test_stages_of_the_same_size_say_what_a_stage_takes(store: str) -> None:
    taken = {a.manifest.stage: a.manifest.seconds for a in LocalStore(Path(store)).artifacts()}
    usual = median_stage_seconds(store, CONFIG)
    assert {stage: usual[stage] for stage in taken} == taken and len(taken) == 3
    assert predict_run(LOG, store, [0], CONFIG)["basis"] == "stages in this store"


def test_stages_of_another_size_say_nothing(store: str) -> None:
    usual = median_stage_seconds(store, LARGE)
    # At the larger size GNet takes many times as long, whatever the store holds.
    assert usual == median_stage_seconds(f"{store}-of-nothing", LARGE) and usual["gnet"] > 30
    predicted = predict_run(LOG, store, [0], LARGE)
    assert predicted["basis"] == "a table of typical values"
    assert next(row["seconds"] for row in predicted["stages"] if row["stage"] == "gnet") == usual["gnet"]
