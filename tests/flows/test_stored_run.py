"""A run that finds every stage in the store: no Prefect, the same record, and nothing for a store with a gap."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.stored_run import find_stored_run
from genre_tasks.temporary_names import describe_owner
from storage.local import LocalStore
from tests.faults.small_run import LOG, SETTINGS, arguments, environment

SCRIPT = """
import sys
from flows.cli.main import main
try:
    main()
finally:
    print("prefect" in sys.modules, file=sys.stderr)
"""


def test_a_run_that_the_store_answers_starts_no_prefect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "store"
    config = load_configuration("demo", settings=SETTINGS)
    job = Job(LOG, 0, str(store), config.model_dump(mode="json"))
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = run_stage(spec.name, job, refs)
    # What a killed process left; another one's, which still runs, is beside it.
    chunk = (store / str(refs["gnet"].address)).parent
    machine, process, _ = describe_owner().split("-")
    (chunk / f".tmp-abc-{machine}-{process}-1-dead").mkdir()
    (chunk / f".tmp-abc-{describe_owner()}-alive").mkdir()
    command = [sys.executable, "-P", "-c", SCRIPT, *arguments(store)]
    done = subprocess.run(command, cwd=tmp_path, env=environment(tmp_path), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "False"
    record = json.loads(done.stdout)
    assert record["status"] == "done" and Path(record["report"]).is_file()
    served = {stage["stage"]: stage["cached"] for stage in record["chunks"][0]["stages"]}
    assert served == {spec.name: True for spec in PIPELINE}
    assert [path.name.endswith("alive") for path in chunk.glob(".tmp-*")] == [True]
    # A single missing stage is a reason to compute.
    found = find_stored_run(LOG, "demo", str(store), None, config)
    assert found is not None and found.name == record["run"]
    shutil.rmtree(store / str(refs["enet"].address))
    # The run that computes walks the store to tidy up, and once is enough.
    monkeypatch.setattr(LocalStore, "clean_temporaries", lambda *_: pytest.fail("the store is walked twice"))
    assert find_stored_run(LOG, "demo", str(store), None, config) is None
