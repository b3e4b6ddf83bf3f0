"""A dataset of made-up runs: their records in a store, without their artifacts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flows.reconstruction.run_records import name_run_folder
from storage.opening import open_store

STAGES = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet", "evaluate/gnet", "evaluate/enet")


def name_run(number: int) -> str:
    """Twelve hex digits."""
    return f"{number:012x}"


def make_record(number: int, log: str, chunks: int = 2) -> dict[str, Any]:
    """The record of a finished run; the accuracy falls with the number."""
    metrics = {
        "interpolation/psnr": 30.0 - 0.01 * number,
        "interpolation/ssim": 0.9,
        "interpolation/perceptual": 0.2,
        "shift_0m/kernel": 0.001,
        "shift_3m/kernel": 0.002 + 1e-5 * number,
        "interpolation/n": 30.0,
    }
    stages = [
        {
            "stage": stage,
            "key": f"{number:032x}{position:032x}",
            "cached": stage == "ingest",
            "seconds": 1.5 + 0.1 * (number % 17),
            "peak_mib": 900.0,
            "metrics": metrics if stage in ("gnet", "enet") else {},
        }
        for position, stage in enumerate(STAGES)
    ]
    return {
        "status": "done",
        "log": log,
        "preset": "demo",
        "store": "store",
        "run": name_run(number),
        "report": "report.html",
        "config": {},
        "differs": {"gnet.iterations": [100, 2]},
        "chunks": [{"chunk": chunk, "warnings": [], "stages": stages} for chunk in range(chunks)],
        "left_out": [],
    }


def write_run(store: Path, record: dict[str, Any]) -> None:
    """Writes a record where a run would."""
    folder = open_store(str(store)).records.pull(name_run_folder(record["run"]))
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(record))


def make_outcome(log: str, run: str, status: str = "done", **more: Any) -> dict[str, Any]:
    """A row of the table of logs."""
    row = {"log": log, "status": status, "chunks": 2, "left_out": 0, "run": run, "report": "", "seconds": 12.5}
    return row | {"where": "worker-1", "attempts": 1, "why": ""} | more


def make_dataset(store: Path, count: int) -> list[dict[str, Any]]:
    """Runs in the store, every tenth of them without a record; the outcomes of all."""
    outcomes = []
    for number in range(count):
        log = f"pandaset:/data/pandaset/{number:04d}"
        if number % 10 == 9:
            why = f"no such folder (file /data/{number % 3}). Check the path."
            outcomes.append(make_outcome(log, "", "failed", attempts=3, why=why))
            continue
        write_run(store, make_record(number, log))
        outcomes.append(make_outcome(log, name_run(number)))
    return outcomes
