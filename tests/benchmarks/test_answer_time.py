"""The store that the command's answers are timed on, and what is claimed of the times."""

from __future__ import annotations

from pathlib import Path

from benchmarks.exchange.answer_time import answer_time_claims, answer_time_table, write_tiny_run
from flows.pipeline.definition import PIPELINE
from flows.reconstruction.run_records import list_runs
from storage.local import LocalStore


def test_the_tiny_run_is_sound(tmp_path: Path) -> None:
    key = write_tiny_run(tmp_path / "store", chunks=2)
    store = LocalStore(tmp_path / "store")
    assert len(list(store.artifacts())) == 2 * len(PIPELINE)
    assert [error for _, error in store.verify_all() if error is not None] == []
    (record,) = list_runs(str(store.root))
    assert any(stage["key"] == key for stage in record["chunks"][1]["stages"])


def test_the_slowest_machine_is_claimed() -> None:
    def row(median: float) -> dict[str, object]:
        seconds = {"median": median, "low": median / 2, "high": 2 * median, "n": 5}
        return {"chunks": 100, "seconds": dict.fromkeys(("help", "run", "artifact"), seconds)}

    claims = {c.id: c for c in answer_time_claims([row(0.5), row(1.5)])}
    assert not claims["exchange.answer_help"].holds and claims["exchange.answer_run"].holds
    assert claims["exchange.answer_artifact"].measured == 1.5 and claims["exchange.answer_run"].spread == (0.75, 3.0)
    assert all(c.measured is None and not c.holds for c in answer_time_claims([]))
    assert "| help, 100 chunks | 0.50 | 0.25–1.00 |" in list(answer_time_table([row(0.5)]))
