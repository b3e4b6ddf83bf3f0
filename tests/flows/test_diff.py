"""``genre diff``: settings, digests, metrics, Gaussians and pictures of two runs or two artifacts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner, Result

from flows.cli.main import app
from flows.comparison.artifact_comparison import compare_artifacts
from flows.comparison.comparison import Comparison
from flows.comparison.gaussian_differences import compare_gaussians
from flows.comparison.metric_differences import Score, average_scores, compare_scores
from flows.comparison.output_files import write_page
from flows.comparison.run_comparison import compare_runs, open_side
from flows.comparison.setting_differences import list_differences
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.metrics.results import Evaluation, Metric
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from storage.local import LocalStore, Provenance
from storage.store import Artifact
from tests.browser import needs_browser, open_page
from tests.contracts.store_suite import address
from tests.storage.artifact_values import make

NAME = "3m_left_front_camera_04"


def scene(means: torch.Tensor) -> Reconstruction:
    packed = torch.zeros(len(means), 14)
    packed[:, :3] = means
    return Reconstruction(SceneGraph(Gaussians.unpack(packed), torch.zeros(len(means), dtype=torch.int64), ()))


def evaluation(psnr: float, gray: int, kernel: float = 0.1) -> Evaluation:
    pictures = {NAME: np.full((6, 8, 3), gray, np.uint8), f"{NAME}.truth": np.full((6, 8, 3), 120, np.uint8)}
    metrics = (
        Metric("shift_3m/psnr", psnr, 30),
        Metric("shift_3m/kernel", kernel, 30, low=kernel - 0.01, high=kernel + 0.01),
    )
    return Evaluation("gnet", metrics, (), (), pictures)


class Runs:
    """A store with runs of one or more chunks, each with a scene and its evaluation."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = LocalStore(folder)

    def add(self, name: str, log: str = "synthetic:street", gray: int = 100, chunks: int = 1, **config: Any) -> None:
        entries = []
        for k in range(chunks):
            grid = torch.arange(40.0).reshape(-1, 1).repeat(1, 3)
            one = self._commit("gnet", name, k, "reconstruction", scene(grid + 0.001 * (gray - 100)))
            two = self._commit("evaluate/gnet", name, k, "evaluation", evaluation(20 + gray / 100 + k, gray))
            metrics = {"shift_3m/psnr": 20 + gray / 100 + k}
            entries.append({"chunk": k, "stages": [self._entry(one, metrics), self._entry(two, {})]})
        record = {"run": name, "log": log, "preset": "demo", "report": "r.html", "differs": {}, "config": config}
        path = self.folder / "runs" / name / "run.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({**record, "chunks": entries}))

    def _commit(self, stage: str, run: str, chunk: int, kind: str, value: Any) -> Artifact:
        key = (run + f"{chunk:02x}" + stage.encode().hex()).ljust(64, "0")[:64]
        return self.store.commit(address(stage, key, chunk=chunk), kind, value, Provenance({}, {"iterations": 8}))

    def _entry(self, artifact: Artifact, metrics: dict[str, float]) -> dict[str, Any]:
        manifest = artifact.manifest
        return {"stage": manifest.stage, "key": manifest.key, "cached": False, "seconds": 1.0, "metrics": metrics}

    def compare(self, a: str, b: str, chunk: int | None = None) -> Comparison:
        records = [json.loads((self.folder / "runs" / name / "run.json").read_text()) for name in (a, b)]
        return compare_runs(*(open_side(self.store, record) for record in records), chunk=chunk)


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    made = Runs(tmp_path / "store")
    made.add("aa11", gnet={"iterations": 24, "seed": 0})
    made.add("bb22", gray=151, gnet={"iterations": 8, "seed": 0})
    return made


def tables(comparison: Comparison) -> dict[str, list[dict[str, Any]]]:
    return {table.name: table.rows for table in comparison.tables}


def diff(store: Path, *words: str) -> Result:
    arguments = ["diff", *words, "--store", str(store)]
    return CliRunner().invoke(app, arguments, catch_exceptions=False, env={"COLUMNS": "200"})


def test_two_runs(runs: Runs) -> None:
    found = runs.compare("aa11", "bb22")
    shown = tables(found)
    assert shown["settings"] == [{"setting": "gnet.iterations", "A": 24, "B": 8}]
    assert [row["payload"] for row in shown["chunk 0 stages"]] == ["differs", "differs"]
    psnr = next(row for row in shown["chunk 0 metrics after gnet"] if row["metric"] == "shift_3m/psnr")
    assert (psnr["B is"], round(psnr["B − A"], 6)) == ("better", 0.51)
    (static,) = shown["chunk 0 Gaussians after gnet"]
    assert static["B − A"] == 0 and abs(static["moved, median m"] - 0.051 * 3**0.5) < 1e-4
    (pair,) = found.pairs
    assert pair.name == f"chunk-0-after-gnet-{NAME}" and pair.truth is not None and pair.b[0, 0, 0] == 151


def test_a_run_and_itself(runs: Runs) -> None:
    found = runs.compare("aa11", "aa11")
    assert "The settings are the same." in found.notes and found.pairs == []
    assert all(row["payload"] == "same" for row in tables(found)["chunk 0 stages"])
    assert any("same metrics" in note for note in found.notes)


def test_evaluations_are_fetched_before_they_are_read(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[str] = []
    kind = type(runs.store)
    fetch = kind.fetch

    def count(self: Any, artifact: Artifact, suffix: str = "") -> Path:
        fetched.append(artifact.manifest.stage)
        return fetch(self, artifact, suffix)

    monkeypatch.setattr(kind, "fetch", count)
    runs.compare("aa11", "bb22")
    # Of both runs for the scores, and again for the pictures.
    assert fetched.count("evaluate/gnet") == 4


def test_runs_of_different_logs_share_means_only(runs: Runs) -> None:
    runs.add("cc33", log="synthetic:street?seed=7", gray=140, chunks=2)
    found = runs.compare("aa11", "cc33")
    assert any("different logs" in note for note in found.notes) and found.pairs == []
    (means,) = (rows for name, rows in tables(found).items() if "mean metrics" in name)
    assert next(row["B"] for row in means if row["metric"] == "shift_3m/psnr") == pytest.approx(21.9)
    assert not any("Gaussians" in name for name in tables(found))
    with pytest.raises(ConfigError, match=r"different logs.*Leave out --chunk"):
        runs.compare("aa11", "cc33", chunk=1)


def test_many_chunks_are_compared_by_means_or_one_by_one(runs: Runs) -> None:
    runs.add("dd44", chunks=6)
    runs.add("ee55", gray=151, chunks=7)
    found = runs.compare("dd44", "ee55")
    assert "Only B has these chunks: 6." in found.notes and "All payloads are the same in 0 of them." in found.notes
    assert found.pairs == []
    one = runs.compare("dd44", "ee55", chunk=5)
    assert "chunk 5 stages" in tables(one) and len(one.pairs) == 1
    with pytest.raises(InputError, match="do not both have chunk 6"):
        runs.compare("dd44", "ee55", chunk=6)


def record_run(name: str, stages: Mapping[str, Sequence[float | None]]) -> dict[str, Any]:
    """A record whose artifacts are gone: of each stage the PSNR chunk by chunk, ``None`` where the chunk lacks it."""
    chunks = []
    for k in range(max(map(len, stages.values()))):
        found = {stage: values[k] for stage, values in stages.items() if values[k] is not None}
        entries = [
            {"stage": s, "key": f"{name}{k}{s}", "seconds": 1.0, "metrics": {"x/psnr": v}} for s, v in found.items()
        ]
        chunks.append({"chunk": k, "stages": entries})
    return {"run": name, "log": "synthetic:street", "preset": "demo", "config": {}, "chunks": chunks}


def compare_records(store: LocalStore, a: dict[str, Any], b: dict[str, Any]) -> Comparison:
    return compare_runs(open_side(store, a), open_side(store, b))


def test_means_are_over_the_chunks_that_have_a_stage_in_both_runs(runs: Runs) -> None:
    """A run with a budget may leave out ENet in chunks that are hard, and is then no better for it."""
    gnet = [29.0, 29.0, 29.0, 19.0, 19.0]
    every = record_run("aaaa", {"gnet": gnet, "enet": [30.0, 30.0, 30.0, 20.0, 20.0]})
    budget = record_run("bbbb", {"gnet": gnet, "enet": [29.5, 29.5, 29.5, None, None]})
    shown = tables(compare_records(runs.store, every, budget))
    (row,) = shown["enet: mean metrics"]
    assert (row["chunks"], row["A"], row["B"]) == (3, 30.0, 29.5)
    assert (row["B − A"], row["B is"]) == (-0.5, "worse")
    (row,) = shown["gnet: mean metrics"]
    assert (row["chunks"], row["A"], row["B"], row["B is"]) == (5, 25.0, 25.0, "")


def test_a_stage_that_no_chunk_has_in_both_runs_has_no_difference(runs: Runs) -> None:
    gnet = [20.0] * 5
    one = record_run("aaaa", {"gnet": gnet, "enet": [30.0, 26.0, None, None, None]})
    alone = tables(compare_records(runs.store, one, record_run("bbbb", {"gnet": gnet})))
    (row,) = alone["enet: mean metrics"]
    assert (row["chunks"], row["A"], row["B"], row["B is"]) == (2, 28.0, "", "")
    found = compare_records(runs.store, one, record_run("bbbb", {"gnet": gnet, "enet": [None, None, 29.0, None, None]}))
    assert "enet: mean metrics" not in tables(found)
    assert "No chunk has metrics after enet in both runs." in found.notes


def test_an_artifact_that_is_gone_leaves_the_record(runs: Runs) -> None:
    (gone,) = runs.store.artifacts(stage="evaluate/gnet", key_start="bb22")
    runs.store.discard(gone)
    found = runs.compare("aa11", "bb22")
    assert [row["payload"] for row in tables(found)["chunk 0 stages"]] == ["differs", "gone from the store"]
    psnr = next(r for r in tables(found)["chunk 0 metrics after gnet"] if r["metric"] == "shift_3m/psnr")
    assert psnr["B"] == 21.51 and found.pairs == []


def test_intervals_decide_how_sure_a_difference_is() -> None:
    a = {"x/kernel": Score(0.2, (0.19, 0.21)), "x/ssim": Score(0.5), "x/n": Score(3.0)}
    b = {"x/kernel": Score(0.1, (0.09, 0.11)), "x/ssim": Score(0.4), "x/n": Score(3.0)}
    verdicts = {row["metric"]: row["B is"] for row in compare_scores(a, b)}
    assert verdicts == {"x/kernel": "clearly better", "x/ssim": "worse", "x/n": ""}
    near = {"x/kernel": Score(0.195, (0.18, 0.205))}
    assert compare_scores({"x/kernel": a["x/kernel"]}, near)[0]["B is"] == "better, within the intervals"
    infinite = {"x/psnr": Score(float("inf"))}
    assert compare_scores(infinite, infinite)[0]["B − A"] == 0
    assert average_scores([a, b])["x/ssim"].value == pytest.approx(0.45)


def test_settings_of_other_versions_are_named() -> None:
    rows = list_differences({"a": {"b": 1}, "c": None}, {"a": {"b": 1, "d": [2]}})
    assert rows == [
        {"setting": "c", "A": None, "B": "not there"},
        {"setting": "a.d", "A": "not there", "B": [2]},
    ]


def test_new_and_gone_gaussians(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    near = torch.arange(10.0).reshape(-1, 1).repeat(1, 3)
    a = store.commit(address("gnet", "a" * 64), "reconstruction", scene(near))
    b = store.commit(address("gnet", "b" * 64), "reconstruction", scene(torch.cat([near[:8], near + 100])))
    (row,) = compare_gaussians(a.path, b.path)
    assert (row["A"], row["B"], row["new in B"], row["gone from A"]) == (10, 18, "55.6%", "20.0%")
    assert row["moved, median m"] == ""


@pytest.mark.parametrize("kind", ["chunk", "reconstruction", "novel_views", "fixed_views", "pairs", "effects"])
def test_artifacts_of_every_kind(tmp_path: Path, kind: str) -> None:
    store = LocalStore(tmp_path)
    a = store.commit(address("gnet", "a" * 64), kind, make(kind, seed=1))
    b = store.commit(address("gnet", "b" * 64), kind, make(kind, seed=2))
    found = compare_artifacts((store, store), a, b)
    assert {"artifacts", "files", "statistics"} <= set(tables(found))
    same = compare_artifacts((store, store), a, a)
    assert "The payloads are the same, byte by byte." in same.notes and "statistics" not in tables(same)


def test_what_cannot_be_compared_is_one_error(runs: Runs) -> None:
    scenes, evaluations = (list(runs.store.artifacts(kind=k)) for k in ("reconstruction", "evaluation"))
    with pytest.raises(InputError, match="of the kind reconstruction, and B of the kind evaluation"):
        compare_artifacts((runs.store, runs.store), scenes[0], evaluations[0])
    with pytest.raises(InputError, match="a run and an artifact"):
        diff(runs.folder, "aa11", scenes[0].manifest.key)
    with pytest.raises(InputError, match="0 runs or artifacts begin with 'ffff'"):
        diff(runs.folder, "aa11", "ffff")


def test_the_command_writes_a_page_and_strips(runs: Runs, tmp_path: Path) -> None:
    done = diff(runs.folder, "aa11", "bb22", "--html", str(tmp_path / "d.html"), "--out", str(tmp_path / "d"))
    assert done.exit_code == 0 and "gnet.iterations" in done.output and "wrote" in done.output
    strip = np.asarray(Image.open(tmp_path / "d" / f"chunk-0-after-gnet-{NAME}.png"))
    assert strip.shape == (6, 4 * 8, 3)
    assert [int(strip[0, 8 * k, 0]) for k in (0, 1, 3)] == [100, 151, 120]
    # The difference of 51 levels is the end of the scale, which is bright.
    assert strip[0, 16].mean() > 200
    assert "gnet.iterations" in (tmp_path / "d.html").read_text()


@needs_browser
def test_the_page_opens_on_a_phone_without_a_network(runs: Runs, tmp_path: Path) -> None:
    found = runs.compare("aa11", "bb22")
    hostile = replace(found.pairs[0], label='<script>alert("1")</script>' + "x" * 200)
    found.pairs.append(hostile)
    with open_page(write_page(tmp_path / "d.html", found), width_px=390, color_scheme="dark") as opened:
        assert opened.page.evaluate("document.documentElement.scrollWidth") == 390
        assert opened.page.locator(".compare:visible").count() == 2
        assert opened.problems == []
