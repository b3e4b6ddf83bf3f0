"""``genre show``: every kind of artifact, runs of many chunks, and folders outside of a store."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from flows.cli.main import app
from flows.cli.show_run import tabulate_metrics
from flows.plots.artifact_pictures import _DRAWING_FUNCTIONS
from genre_tasks.errors import InputError
from storage.codecs import KINDS
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.storage.artifact_values import MAKERS, make


def show(*words: str) -> Result:
    return CliRunner().invoke(app, ["show", *words], catch_exceptions=False, env={"COLUMNS": "200"})


def test_the_table_of_a_run_needs_no_torch(tmp_path: Path) -> None:
    write_run(tmp_path, 1)
    code = (
        "import sys\n"
        "from typer.testing import CliRunner\n"
        "from flows.cli.main import app\n"
        f"done = CliRunner().invoke(app, ['show', 'abcdef012345', '--store', {str(tmp_path)!r}])\n"
        "assert done.exit_code == 0, done.output\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def write_run(store: Path, chunks: int) -> None:
    """The record of a run whose PSNR after GNet is 20 dB plus the chunk's number."""

    def stage(name: str, chunk: int, **metrics: float) -> dict[str, Any]:
        return {"stage": name, "key": f"{chunk:02d}{name}", "cached": False, "seconds": 2.0, "metrics": metrics}

    numbers = range(chunks)
    record = {
        "run": "abcdef012345",
        "log": "synthetic:street",
        "preset": "demo",
        "report": "report.html",
        "config": {},
        "differs": {},
        "chunks": [
            {"chunk": k, "stages": [stage("ingest", k), stage("gnet", k, **{"interpolation/psnr": 20.0 + k})]}
            for k in numbers
        ],
    }
    folder = store / "runs/abcdef012345"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(record))


@pytest.mark.parametrize("kind", MAKERS)
def test_every_kind_has_statistics_and_histograms(tmp_path: Path, kind: str) -> None:
    artifact = LocalStore(tmp_path).commit(address(), kind, make(kind))
    done = show(artifact.manifest.key[:8], "--store", str(tmp_path))
    assert done.exit_code == 0
    for word in ("manifest", "files", "histogram", "mean", artifact.manifest.payload_digest):
        assert word in done.output, word
    assert re.search("[▁▂▃▄▅▆▇█]", done.output)


def test_every_kind_has_a_picture() -> None:
    assert set(_DRAWING_FUNCTIONS) == set(KINDS) == set(MAKERS)


def test_results_stand_row_by_row(tmp_path: Path) -> None:
    value = make("evaluation")
    artifact = LocalStore(tmp_path).commit(address(), "evaluation", value)
    text = show(artifact.manifest.key, "--store", str(tmp_path)).output
    for metric in value.metrics:
        assert re.search(rf"{re.escape(metric.name)}\W+{metric.value:.4g}", text), metric


def test_a_short_run_shows_every_stage_and_metric(tmp_path: Path) -> None:
    write_run(tmp_path, 2)
    text = show("abc", "--store", str(tmp_path)).output
    assert "01gnet" in text and "00ingest" in text and re.search(r"interpolation/psnr\W+21", text)


def test_a_long_run_shows_means_and_any_chunk_on_request(tmp_path: Path) -> None:
    write_run(tmp_path, 101)
    text = show("abc", "--store", str(tmp_path)).output
    assert "means of 101 chunks" in text and re.search(r"interpolation/psnr\W+70", text)
    assert len(text.splitlines()) < 101 + 60
    one = show("abc", "--chunk", "100", "--store", str(tmp_path)).output
    assert re.search(r"interpolation/psnr\W+120", one) and "means of" not in one
    with pytest.raises(InputError, match="no chunk 101"):
        show("abc", "--chunk", "101", "--store", str(tmp_path))


def test_a_folder_outside_of_a_store_is_shown(tmp_path: Path) -> None:
    artifact = LocalStore(tmp_path / "store").commit(address(), "effects", make("effects"))
    shutil.copytree(artifact.path, tmp_path / "rollout")
    done = show(str(tmp_path / "rollout"))
    assert done.exit_code == 0 and artifact.manifest.key in done.output
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no manifest"):
        show(str(tmp_path / "empty"))


def test_only_the_manifest_that_is_asked_for_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from storage import local

    store = LocalStore(tmp_path)
    keys = [f"{k}" * 64 for k in range(9)]
    for key in keys:
        store.commit(address("gnet", key), "evaluation", make("evaluation"))
    read: list[str] = []
    real = local.load_manifest
    monkeypatch.setattr(local, "load_manifest", lambda folder: (read.append(folder.name), real(folder))[1])
    assert [a.manifest.key for a in store.artifacts(key_start="77")] == [keys[7]] == read
    assert [a.manifest.key for a in store.artifacts(key=keys[3])] == [keys[3]] and len(read) == 2
    assert len(list(store.artifacts())) == 9


def test_metrics_of_one_stage_alone_leave_the_others_empty() -> None:
    stages = [{"stage": "gnet", "metrics": {"a/psnr": 1.0, "a/n": 2.0}}, {"stage": "fnet", "metrics": {"b/psnr": 3.0}}]
    assert tabulate_metrics(stages) == [
        {"metric": "a/psnr", "gnet": 1.0, "fnet": ""},
        {"metric": "a/n", "gnet": 2.0, "fnet": ""},
        {"metric": "b/psnr", "gnet": "", "fnet": 3.0},
    ]
