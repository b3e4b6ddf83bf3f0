"""Reports that are written again, and the reliable range that is then in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flows.reconstruction.range_record import read_range_record, write_range_record
from flows.reconstruction.rewritten_report import read_finished_run, rewrite_report
from flows.reconstruction.run_records import find_run_folder, list_runs
from genre_tasks.config import RangeConfig
from genre_tasks.errors import InputError
from genre_tasks.reliability.guards import Guards
from genre_tasks.reliability.reliable_range import ReliableRange, find_reliable_range
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.storage.artifact_values import make

KINDS_BY_STAGE = {"ingest": "chunk", "effects": "effects", "gnet": "reconstruction", "evaluate/gnet": "evaluation"}


@pytest.fixture
def store(tmp_path: Path) -> str:
    """A store with one run of one chunk, whose record bears the name that its keys give."""
    opened = LocalStore(tmp_path)
    stages: list[dict[str, Any]] = []
    for stage, kind in KINDS_BY_STAGE.items():
        artifact = opened.commit(address(stage, stage.encode().hex().ljust(64, "0")), kind, make(kind))
        stages.append({"stage": stage, "key": artifact.manifest.key, "cached": True, "seconds": 1.0, "metrics": {}})
    record = {
        "log": "synthetic:street?seed=1",
        "preset": "demo",
        "report": "",
        "config": {},
        "differs": {"gnet.iterations": [24, 8]},
        "chunks": [{"chunk": 0, "stages": stages, "warnings": ["made with less <time>"]}],
    }
    name = read_finished_run(str(tmp_path), record).name
    folder = tmp_path / "runs" / name
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({**record, "run": name}))
    return str(tmp_path)


def reliable_range() -> ReliableRange:
    views = [Guards("front", 0, shift, 30.0 - 2 * abs(shift), 0.7, 0.0, 0.0) for shift in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    return find_reliable_range(views, RangeConfig(shifts_m=(1.0, 2.0), max_drop_db=1.0))


def test_a_range_is_in_the_report_that_is_written_again(store: str) -> None:
    (record,) = list_runs(store)
    before = rewrite_report(store, record["run"][:4])
    assert before == find_run_folder(store, record["run"]) / "report.html"
    first = before.read_text()
    assert "Not measured" in first and "made with less &lt;time&gt;" in first and "gnet.iterations = 8" in first
    assert rewrite_report(store, record["run"]).read_text() == first
    found = reliable_range()
    write_range_record(before.parent, 0, "gnet", found)
    read = read_range_record(before.parent, 0)
    assert read is not None and (read.left_m, read.right_m) == (found.left_m, found.right_m)
    assert [shift for shift, *_ in read.points] == [-2.0, -1.0, 0.0, 1.0, 2.0]
    text = rewrite_report(store, record["run"]).read_text()
    assert f"{found.left_m:.1f} m" in text and "The scene after GNet can be trusted" in text


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"left_m": "x"}'])
def test_a_damaged_range_is_named_and_costs_nothing_else(store: str, content: bytes) -> None:
    (record,) = list_runs(store)
    path = write_range_record(find_run_folder(store, record["run"]), 0, "gnet", reliable_range())
    path.write_bytes(content)
    with pytest.raises(InputError, match="reliable range is damaged") as caught:
        read_range_record(path.parent.parent, 0)
    assert caught.value.file == str(path)
    text = rewrite_report(store, record["run"]).read_text()
    assert "reliable range is damaged" in text and "Lineage" in text


def test_a_run_without_its_artifacts_is_one_error(store: str) -> None:
    opened = LocalStore(Path(store))
    opened.discard(next(opened.artifacts(stage="gnet")))
    (record,) = list_runs(store)
    with pytest.raises(InputError, match="an artifact of this run is gone"):
        rewrite_report(store, record["run"])
