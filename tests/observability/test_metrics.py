"""Metrics: what Prometheus reads is what the processes counted, whoever was killed in between."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from flows.observability import counter_files
from flows.observability import metric_definitions as metrics
from flows.observability.counter_files import MAX_FILES, TOTALS, CounterFolder, Counts
from flows.observability.exporter import (
    METRICS_PORT,
    main,
    make_registry,
    read_metrics_address,
    serve_metrics,
    serve_metrics_if_asked,
)
from flows.observability.process_counters import METRICS_FOLDER, ProcessCounters, get_counters
from flows.observability.stage_observation import (
    count_read,
    count_written,
    measure_lease_wait,
    observe_stage,
)
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.progress import silent
from storage.manifest import FileEntry
from tests.faults.small_run import ROOT

STAGE = "genre_stages_total"
LABELS = ("stage", "outcome", "le")


def samples(folder: Path) -> dict[tuple[str, ...], float]:
    """Every sample that Prometheus would read, by name and values of its labels."""
    return parse(generate_latest(make_registry(folder)).decode())


def parse(text: str) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *(sample.labels[label] for label in LABELS if label in sample.labels)): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def entry(size: int) -> FileEntry:
    return FileEntry(path="metrics.parquet", size=size, sha256="0" * 64)


def count_in_process(folder: Path, code: str) -> subprocess.Popen[str]:
    """A process that counts in the folder, runs the code and says that it has."""
    lines = (
        "import os, signal, time\n"
        "from flows.observability.stage_observation import *\n"
        f"{code}\nprint('counted', flush=True)\ntime.sleep(60)\n"
    )
    env = os.environ | {METRICS_FOLDER: str(folder), "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", lines], env=env, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "counted\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait(20)


def write_ended(folder: Path, count: int, stage: str = "gnet") -> None:
    """Files of processes that have ended, each with one finished stage."""
    counter_folder = CounterFolder(folder)
    live = counter_folder.name_file()
    # The start of this process with another number: no such process is there.
    for number in range(count):
        name = live.name.replace(f"-{os.getpid()}-", f"-{4_200_000 + number}-")
        counter_folder.write(live.with_name(name), Counts({(STAGE, stage, "computed"): 1.0}))


def counted_files(folder: Path) -> list[Path]:
    return sorted((folder / "counts").glob("process-*.json"))


@pytest.fixture()
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(METRICS_FOLDER, str(tmp_path / "metrics"))
    return tmp_path / "metrics"


def test_a_stage_is_counted_by_its_outcome(folder: Path) -> None:
    with observe_stage("log", 0, "gnet", attempt=1) as observation:
        assert samples(folder)[("genre_running_stages", "gnet")] == 1
        count_read([entry(1000), entry(20)])
        count_read([entry(4)])
        count_written([entry(2048)])
        measure_lease_wait(silent)(0, 1, "another process computes this artifact")
    with observe_stage("log", 0, "gnet") as observation:
        observation.is_cached = True
    with pytest.raises(InputError), observe_stage("log", 0, "enet"):
        raise InputError("no image", remedy="Copy it.")
    found = samples(folder)
    assert found[(STAGE, "gnet", "computed")] == 1
    assert found[(STAGE, "gnet", "cached")] == 1
    assert found[(STAGE, "enet", "failed")] == 1
    assert found[("genre_cache_hits_total", "gnet")] == 1
    assert found[("genre_artifact_bytes_read_total", "gnet")] == 1024
    assert found[("genre_artifact_bytes_written_total", "gnet")] == 2048
    assert found[("genre_stage_retries_total", "gnet")] == 1
    assert found[("genre_lease_waits_total", "gnet")] == 1
    assert 0 < found[("genre_lease_wait_seconds_total", "gnet")] < 60
    assert found[("genre_running_stages", "gnet")] == 0
    assert found[("genre_running_stages", "enet")] == 0


def test_a_histogram_is_cumulative_and_has_its_sum(folder: Path) -> None:
    counters = get_counters()
    assert counters is not None
    for value in (0.01, 0.2, 0.25, 50.0, 9999.0):
        counters.observe(metrics.STAGE_SECONDS, "gnet", "computed", value=value)
    counters.save()
    found = samples(folder)
    buckets = {key[-1]: n for key, n in found.items() if key[0] == "genre_stage_seconds_bucket"}
    assert [buckets[end] for end in ("0.05", "0.1", "0.25", "30.0", "60.0", "3600.0", "+Inf")] == [1, 1, 3, 3, 4, 4, 5]
    assert found[("genre_stage_seconds_count", "gnet", "computed")] == 5
    assert found[("genre_stage_seconds_sum", "gnet", "computed")] == pytest.approx(10049.46)


def test_without_the_variable_nothing_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(METRICS_FOLDER, raising=False)
    monkeypatch.chdir(tmp_path)
    with observe_stage("log", 0, "gnet"):
        count_read([entry(1)])
    assert get_counters() is None
    assert not list(tmp_path.iterdir())


def test_counting_needs_no_package_of_prometheus(folder: Path) -> None:
    code = (
        "import sys\nfrom flows.observability.stage_observation import observe_stage\n"
        "with observe_stage('log', 0, 'gnet'): pass\nsys.exit('prometheus_client' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    assert samples(folder)[(STAGE, "gnet", "computed")] == 1


def test_a_killed_process_loses_and_doubles_nothing(folder: Path) -> None:
    finished = "with observe_stage('log', 0, 'gnet') as o: o.bytes_written = 10"
    running = "entered = observe_stage('log', 0, 'enet')\nentered.__enter__()"
    process = count_in_process(folder, f"{finished}\n{running}")
    found = samples(folder)
    assert found[(STAGE, "gnet", "computed")] == 1
    assert found[("genre_running_stages", "enet")] == 1
    kill(process)
    for _ in range(3):
        found = samples(folder)
        assert found[(STAGE, "gnet", "computed")] == 1
        assert found[("genre_artifact_bytes_written_total", "gnet")] == 10
        assert ("genre_running_stages", "enet") not in found
    assert not counted_files(folder)


def test_a_forked_process_counts_for_itself(folder: Path) -> None:
    code = (
        "with observe_stage('log', 0, 'gnet'): pass\n"
        "child = os.fork()\n"
        "with observe_stage('log', 0, 'enet'): pass\n"
        "if child == 0: os._exit(0)\n"
        "os.waitpid(child, 0)"
    )
    kill(count_in_process(folder, code))
    found = samples(folder)
    assert found[(STAGE, "gnet", "computed")] == 1
    assert found[(STAGE, "enet", "computed")] == 2


def test_the_number_of_files_is_bounded_without_an_exporter(folder: Path) -> None:
    write_ended(folder, MAX_FILES + 1)
    get_counters()
    assert not counted_files(folder)
    assert samples(folder)[(STAGE, "gnet", "computed")] == MAX_FILES + 1


@pytest.mark.parametrize("step", ["before the totals", "after the totals", "while files go"])
def test_a_kill_while_folding_doubles_nothing(folder: Path, step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ended(folder, 5)
    real_unlink = Path.unlink
    unlinked = []

    def unlink(path: Path, missing_ok: bool = False) -> None:
        if path.name.startswith("process-"):
            if step == "after the totals" or len(unlinked) == 2:
                raise SystemExit("killed")
            unlinked.append(path)
        real_unlink(path, missing_ok)

    def replace(path: Path, target: Path) -> None:
        raise SystemExit("killed")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        if step == "before the totals":
            patch.setattr(Path, "replace", replace)
        with pytest.raises(SystemExit):
            samples(folder)
    assert counted_files(folder)
    write_ended(folder, 1, stage="enet")
    for _ in range(2):
        found = samples(folder)
        assert found[(STAGE, "gnet", "computed")] == 5
        assert found[(STAGE, "enet", "computed")] == 1
    assert not counted_files(folder)


def test_a_process_whose_file_was_folded_goes_on_without_doubling(folder: Path) -> None:
    counters = ProcessCounters(CounterFolder(folder))
    counters.add(metrics.CACHE_HITS, "gnet")
    counters.save()
    (path,) = counted_files(folder)
    # As after a day without a word from another container: its process cannot be asked for.
    machine = path.name.split("-")[1]
    foreign = path.with_name(path.name.replace(machine, "0" * 8))
    path.rename(foreign)
    os.utime(foreign, (1.0, 1.0))
    assert samples(folder)[("genre_cache_hits_total", "gnet")] == 1
    assert not counted_files(folder)
    counters.add(metrics.CACHE_HITS, "gnet", amount=2)
    counters.save()
    assert samples(folder)[("genre_cache_hits_total", "gnet")] == 3


def test_a_damaged_file_does_not_hide_the_others(folder: Path) -> None:
    write_ended(folder, 2)
    (folder / "counts" / "process-half.json").write_text('{"totals": [[')
    assert samples(folder)[(STAGE, "gnet", "computed")] == 2


def test_a_folder_that_cannot_be_written_ends_no_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(METRICS_FOLDER, str(tmp_path / "file"))
    for _ in range(2):
        with observe_stage("log", 0, "gnet"):
            pass
    assert [record.name for record in caplog.records] == ["genre.metrics"]


def test_the_exporter_answers_what_was_counted(folder: Path) -> None:
    with observe_stage("log", 0, "gnet"):
        pass
    with serve_metrics(folder, 0) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            text = answer.read().decode()
        with pytest.raises(ConfigError, match="cannot listen"), serve_metrics(folder, port):
            pass
    assert parse(text)[(STAGE, "gnet", "computed")] == 1
    for metric in metrics.METRICS:
        assert f"# HELP {metric.name} {metric.help}" in text
        assert f"# TYPE {metric.name} {metric.kind}" in text


def test_the_exporter_is_a_command(folder: Path) -> None:
    write_ended(folder, 1)
    env = os.environ | {METRICS_PORT: "0", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "flows.observability.exporter"]
    process = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        address = process.stderr.readline().split()[-1]
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert parse(answer.read().decode())[(STAGE, "gnet", "computed")] == 1
    finally:
        process.terminate()
        process.wait(20)
    done = subprocess.run(command, env=env | {METRICS_PORT: "no"}, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "GENRE_METRICS_PORT=no is no port" in done.stderr


def test_the_environment_decides_whether_there_is_an_exporter(folder: Path) -> None:
    with serve_metrics_if_asked({}) as port:
        assert port is None
    with serve_metrics_if_asked({METRICS_FOLDER: str(folder), METRICS_PORT: "0"}) as port:
        assert port
    with pytest.raises(ConfigError, match="GENRE_METRICS_DIR is not set"):
        read_metrics_address({METRICS_PORT: "9464"})


def test_a_folder_of_counts_below_no_home_folder_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(METRICS_FOLDER, "~nobody-of-this-name/metrics")
    monkeypatch.setenv(METRICS_PORT, "0")
    with pytest.raises(InputError, match=r"no home folder of this user .*nobody-of-this-name"):
        get_counters()
    with pytest.raises(SystemExit, match=r"no home folder of this user .*nobody-of-this-name"):
        main()


def test_totals_name_what_they_hold(folder: Path) -> None:
    write_ended(folder, 3)
    names = [path.name for path in counted_files(folder)]
    samples(folder)
    assert json.loads((folder / "counts" / TOTALS).read_text())["folded"] == names


def test_a_process_that_is_folded_meanwhile_is_read_all_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counters = CounterFolder(folder)
    counters.write(counters.name_file(), Counts({(STAGE, "gnet", "computed"): 1.0}))
    ended: set[str] = set()
    read_counts = counter_files._read_counts
    others: list[threading.Thread] = []

    def end_before_it_is_read(path: Path) -> Counts:
        # Once: the process ends, and another one that scrapes folds its file.
        if not others:
            ended.add(path.name)
            others.append(threading.Thread(target=CounterFolder(folder).read))
            others[0].start()
            others[0].join(1.0)
        return read_counts(path)

    monkeypatch.setattr(counter_files, "is_abandoned", lambda path: path.name in ended)
    monkeypatch.setattr(counter_files, "_read_counts", end_before_it_is_read)
    assert counters.read().totals == {(STAGE, "gnet", "computed"): 1.0}
    others[0].join(20)
    assert counters.read().totals == {(STAGE, "gnet", "computed"): 1.0}
    assert not counted_files(folder)
