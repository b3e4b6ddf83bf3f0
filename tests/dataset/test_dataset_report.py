"""The report of a dataset: complete, honest about what is missing or damaged, self-contained and bounded."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.dataset.dataset_summary import DatasetSummary, LogFailure, LogSummary, summarise_dataset
from flows.dataset.report.histograms import draw_histogram
from flows.dataset.report.log_table import build_log_rows, list_metric_columns, list_stage_columns
from flows.dataset.report.writing import MAX_BYTES, write_dataset_report
from flows.dataset.worst_views import COUNT, WorstView, find_worst_views
from flows.reconstruction.range_record import FOLDER as RANGES
from genre_tasks.metrics.results import Evaluation, Metric
from storage.address import Address
from storage.codecs.png import encode_png
from storage.opening import open_store
from tests.browser import needs_browser, open_page
from tests.dataset.dataset_values import STAGES, make_dataset, make_outcome, make_record, name_run, write_run
from tests.flows.test_report import Reader

LOG = "pandaset:/data/pandaset/0000"
PICTURE = "3m_left_front_camera_04"


def view(psnr: float, seed: int, height: int = 9) -> WorstView:
    noise = np.random.default_rng(seed).integers(0, 255, (height, height * 16 // 9, 3), dtype=np.uint8)
    png = encode_png(noise)
    return WorstView(f"log-{seed}", name_run(seed), 0, "enet", PICTURE, psnr, png, png)


def write_range(store: Path, run: str, chunk: int, left_m: float, right_m: float) -> Path:
    folder = open_store(str(store)).records.pull(f"runs/{run}") / RANGES
    folder.mkdir(exist_ok=True)
    sides = {"stage": "enet", "left_m": left_m, "right_m": right_m, "farthest_m": 4.0, "limit_db": 20.0, "points": []}
    path = folder / f"chunk-{chunk}-curve.json"
    path.write_text(json.dumps(sides))
    return path


@pytest.fixture()
def summary(tmp_path: Path) -> DatasetSummary:
    """Of twenty logs of which two failed."""
    return summarise_dataset(str(tmp_path / "store"), "demo", make_dataset(tmp_path / "store", 20))


def test_a_log_has_its_means_seconds_and_cached_stages(tmp_path: Path) -> None:
    record = make_record(0, LOG)
    record["chunks"][1]["stages"] = [stage | {"metrics": {}} for stage in record["chunks"][1]["stages"]]
    other = {"interpolation/psnr": 20.0, "shift_3m/kernel": float("nan")}
    enet = next(stage for stage in record["chunks"][1]["stages"] if stage["stage"] == "enet")
    enet["metrics"] = other
    write_run(tmp_path, record)
    write_range(tmp_path, name_run(0), 0, 2.5, 1.75)
    write_range(tmp_path, name_run(0), 1, 1.8, 3.0)
    (log,) = summarise_dataset(str(tmp_path), "demo", [make_outcome(LOG, name_run(0))]).logs
    assert log.metrics["interpolation/psnr"] == 25.0
    assert log.metrics["shift_3m/kernel"] == 0.002
    assert (log.cached_stages, log.stages, log.chunks) == (2, 2 * len(STAGES), 2)
    assert log.stage_seconds["gnet"] == 3.0
    # Both evaluations of both chunks.
    assert log.stage_seconds["evaluate"] == 6.0
    assert log.range_m == 1.75
    assert log.seconds == 12.5


def test_missing_and_damaged_records_become_failures(tmp_path: Path) -> None:
    write_run(tmp_path, make_record(0, LOG))
    write_run(tmp_path, make_record(1, "b"))
    (tmp_path / f"runs/{name_run(1)}/run.json").write_text('{"run": 1')
    write_run(tmp_path, make_record(2, "c"))
    write_range(tmp_path, name_run(2), 0, 1.0, 1.0).write_text("{")
    outcomes = [make_outcome(LOG, name_run(0)), make_outcome("b", name_run(1)), make_outcome("c", name_run(2))]
    summary = summarise_dataset(str(tmp_path), "demo", [*outcomes, make_outcome("d", "f" * 12)])
    assert [log.log for log in summary.logs] == [LOG, "b", "c", "d"]
    assert summary.logs[0].metrics and summary.logs[2].metrics
    reasons = {failure.log: failure.reason for failure in summary.failures}
    assert "record of a run is damaged" in reasons["b"]
    assert "range is damaged" in reasons["c"]
    assert "0 runs of this store" in reasons["d"]
    assert all(failure.remedy for failure in summary.failures)


@pytest.mark.parametrize("damaged", [7, [1], {"a": 1}, None])
def test_a_damaged_setting_of_one_run_costs_only_itself(tmp_path: Path, damaged: object) -> None:
    write_run(tmp_path, make_record(0, LOG))
    write_run(tmp_path, make_record(1, "b") | {"differs": {"gnet.iterations": damaged}})
    write_range(tmp_path, name_run(1), 0, 1.0, 1.0)
    outcomes = [make_outcome(LOG, name_run(0)), make_outcome("b", name_run(1))]
    summary = summarise_dataset(str(tmp_path), "demo", outcomes)
    (failure,) = summary.failures
    assert failure.log == "b" and failure.remedy
    assert f"run {name_run(1)} names no two values for gnet.iterations" in failure.reason
    assert [(difference.used, difference.logs) for difference in summary.differs] == [(2, 1)]
    assert summary.logs[1].metrics and summary.logs[1].range_m == 1.0
    page = write_dataset_report(tmp_path / "report.html", summary).read_text()
    assert "names no two values" in page


def test_a_dataset_by_chunk_counts_logs_and_names_chunks(tmp_path: Path) -> None:
    outcomes = []
    for number, (log, chunk) in enumerate([(LOG, 0), (LOG, 1), ("b", 0)]):
        record = make_record(number, log, chunks=1)
        record["chunks"][0]["chunk"] = chunk
        write_run(tmp_path, record)
        outcomes.append(make_outcome(log, name_run(number), chunk=chunk))
    outcomes += [
        make_outcome("b", "f" * 12, "failed", chunk=1),
        # A log that could not be opened where the chunks were counted.
        make_outcome("c", "", "failed", chunk="", why="no such log"),
    ]
    summary = summarise_dataset(str(tmp_path), "demo", outcomes)
    assert [(log.log, log.chunk) for log in summary.logs] == [(LOG, 0), (LOG, 1), ("b", 0), ("b", 1), ("c", None)]
    assert [(failure.log, failure.chunk) for failure in summary.failures] == [("b", 1), ("c", None)]
    assert summary.differs[0].logs == 2
    rows = [row.log for row in build_log_rows(summary.logs, list_metric_columns(summary))]
    assert rows == [f"{LOG} · chunk 0", f"{LOG} · chunk 1", "b · chunk 0", "b · chunk 1", "c"]
    page = write_dataset_report(tmp_path / "report.html", summary).read_text()
    assert [int(x) for x in re.findall(r"<strong>(\d+)</strong>", page)][:5] == [3, 5, 3, 0, 2]
    assert "Dataset of 3 logs" in page and "of 5 runs" in page and "of 5 logs" not in page


def test_chunks_that_were_left_out_have_reason_and_remedy(tmp_path: Path) -> None:
    left_out = {"class": "InputError", "message": "no source view", "remedy": "Take more frames.", "chunk": 1}
    write_run(tmp_path, make_record(0, LOG, chunks=1) | {"left_out": [left_out], "status": "partly_done"})
    outcome = make_outcome(LOG, name_run(0), "partly_done", why="1 of 2 chunks left out", attempts=2)
    (failure,) = summarise_dataset(str(tmp_path), "demo", [outcome]).failures
    assert failure == LogFailure(LOG, 1, "partly_done", "no source view", "Take more frames.", "worker-1", 2)


def test_settings_that_differ_are_counted(summary: DatasetSummary) -> None:
    (difference,) = summary.differs
    assert (difference.key, difference.preset, difference.used, difference.logs) == ("gnet.iterations", 100, 2, 18)


def test_credentials_are_not_in_the_summary(tmp_path: Path) -> None:
    secret = "pa55word"
    log = f"pandaset:s3://user:{secret}@host/a"
    outcome = make_outcome(log, "", "failed", why=f"no answer from https://u:{secret}@host/?sig={secret}")
    summary = summarise_dataset(str(tmp_path), "demo", [outcome])
    page = write_dataset_report(tmp_path / "report.html", summary).read_text()
    assert secret not in page
    assert secret not in json.dumps(summary.as_values())


def evaluation(shade: int) -> Evaluation:
    truth = np.full((8, 12, 3), 100, np.uint8)
    pictures = {PICTURE: truth + shade, f"{PICTURE}.truth": truth, "0m_front_camera_05": truth + 1}
    metrics = (Metric("interpolation/psnr", 24.0, 3),)
    return Evaluation("enet", metrics, pictures=pictures | {"0m_front_camera_05.truth": truth, "0m_other_1": truth})


def test_the_worst_views_are_those_of_the_worst_chunks(tmp_path: Path) -> None:
    store = open_store(str(tmp_path))
    records = []
    for number in range(4):
        record = make_record(100 * number, f"log-{number}", chunks=1)
        key = next(s["key"] for s in record["chunks"][0]["stages"] if s["stage"] == "evaluate/enet")
        address = Address(dataset="pandaset", log=f"log-{number}", chunk=0, stage="evaluate/enet", key=key)
        # The worst log of all has lost its evaluation.
        if number < 3:
            store.commit(address, "evaluation", evaluation(10 * (number + 1)))
        records.append(record)
    found = find_worst_views(store, records, count=2)
    assert [(v.log, v.name, round(v.psnr, 2)) for v in found] == [
        ("log-2", PICTURE, 18.59),
        ("log-1", PICTURE, 22.11),
    ]
    assert find_worst_views(store, []) == ()


def test_a_histogram_counts_every_finite_value_once() -> None:
    plot = draw_histogram("PSNR, dB", [1.0, 1.0, 2.0, 5.0, float("inf"), float("nan")], 1)
    assert plot is not None
    assert sum(int(bar.words.rpartition(": ")[2]) for bar in plot.bars) == 4
    assert plot.summary == "1.0 … 1.5 … 5.0"
    tallest = max(plot.bars, key=lambda bar: bar.height)
    assert tallest.words.endswith(": 2")
    assert draw_histogram("one", [3.0], 1) is None
    assert draw_histogram("equal", [3.0, 3.0], 1) is None


def test_tables_have_a_column_only_for_what_was_measured(summary: DatasetSummary) -> None:
    titles = [column.title for column in list_metric_columns(summary)]
    assert titles == [
        "PSNR, dB",
        "SSIM",
        "Perceptual",
        "Kernel, on the path",
        "Kernel, 3 m",
        "Chunks",
        "Seconds",
        "Cached",
    ]
    with_range = replace(summary, logs=(replace(summary.logs[0], range_m=2.0), *summary.logs[1:]))
    assert "Range, m" in [column.title for column in list_metric_columns(with_range)]
    stages = [column.title for column in list_stage_columns(summary)]
    assert stages == ["ingest", "effects", "initial", "gnet", "novel views", "fnet", "enet", "evaluate"]
    failed = build_log_rows(summary.logs, list_metric_columns(summary))[9]
    assert (failed.status, failed.link, failed.cells[0].text, failed.cells[0].sort_key) == ("failed", "", "–", "")


def test_the_page_is_complete_escaped_and_fetches_nothing(tmp_path: Path, summary: DatasetSummary) -> None:
    odd = "pandaset:<script>alert(1)</script>&x"
    logs = (*summary.logs, LogSummary(odd, "failed"))
    failures = (*summary.failures, LogFailure(odd, 3, "failed", "a <b>bad</b> file", "Copy it."))
    made = replace(summary, logs=logs, failures=failures, worst_views=(view(12.345, 1),))
    page = write_dataset_report(tmp_path / "datasets" / "abc" / "report.html", made).read_text()
    reader = Reader(page)
    text = " ".join(reader.text)
    assert odd in text and "<script>alert" not in page
    for words in ("Dataset of 21 logs", "What is not done", "Copy it.", "3 attempts", "gnet.iterations = 2", "12.3 dB"):
        assert words in text
    assert f"../../runs/{name_run(0)}/report.html" in reader.addresses
    assert all(address.startswith(("data:", "../../runs/", "#")) for address in reader.addresses)
    assert [float(x) for x in re.findall(r"<strong>(\d+)</strong>", page)][:4] == [21.0, 18.0, 0.0, 3.0]


def test_an_empty_dataset_and_one_under_way_have_a_page(tmp_path: Path) -> None:
    page = write_dataset_report(tmp_path / "empty.html", DatasetSummary("demo", "store", ())).read_text()
    Reader(page)
    waiting = DatasetSummary("demo", "store", (LogSummary("a", "waiting"), LogSummary("b", "running")))
    reader = Reader(write_dataset_report(tmp_path / "waiting.html", waiting).read_text())
    assert {"Waiting", "Running"} <= set(reader.text)


def test_the_size_is_bounded_for_a_thousand_logs(tmp_path: Path) -> None:
    outcomes = make_dataset(tmp_path, 1000)
    summary = summarise_dataset(str(tmp_path), "demo", outcomes)
    assert len(summary.logs) == 1000
    # Noise of the largest stored size: no other picture takes more bytes.
    noisy = replace(summary, worst_views=tuple(view(10.0 + n, n, height=720) for n in range(COUNT)))
    path = write_dataset_report(tmp_path / "report.html", noisy)
    assert path.stat().st_size <= MAX_BYTES
    text = path.read_text()
    assert text.count('<tr><th scope="row">') == 1900
    assert 'alt="Render' in text


def test_the_values_are_json(summary: DatasetSummary) -> None:
    made = replace(summary, worst_views=(view(float("inf"), 1),))
    values: dict[str, Any] = json.loads(json.dumps(made.as_values(), allow_nan=False))
    assert values["logs"][0]["metrics"]["interpolation/psnr"] == 30.0
    assert values["worst_views"][0] == {
        "log": "log-1",
        "run": name_run(1),
        "chunk": 0,
        "stage": "enet",
        "name": PICTURE,
        "psnr": None,
    }


@needs_browser
@pytest.mark.parametrize(("width_px", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_in_a_browser(tmp_path: Path, summary: DatasetSummary, width_px: int, scheme: str) -> None:
    path = write_dataset_report(tmp_path / "report.html", replace(summary, worst_views=(view(12.0, 1, 90),)))
    with open_page(path, width_px, color_scheme=scheme) as opened:
        page = opened.page
        assert page.evaluate("document.documentElement.scrollWidth") <= width_px
        table = page.locator("table.sortable").first
        # A name is not broken after every letter.
        assert table.locator("tbody th").first.bounding_box()["width"] > 150
        first = table.locator("tbody tr").first
        heading = table.locator("thead th").nth(2)
        heading.locator("button").click()
        # Ascending: the worst log of those that have a value.
        assert "/0018" in first.inner_text()
        heading.locator("button").click()
        assert heading.get_attribute("aria-sort") == "descending"
        assert "/0000" in first.inner_text()
        assert "–" in table.locator("tbody tr").last.inner_text()
        page.locator("#filter").fill("0003")
        assert table.locator("tbody tr:visible").count() == 1
        assert not opened.problems
