"""Records of runs, as they may be found in a store: sound, cut off, of something else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flows.reconstruction.run_records import list_runs
from genre_tasks.errors import InputError

STAGE = {"stage": "gnet", "key": "ab" * 32, "cached": False, "seconds": 1.5, "metrics": {"psnr": 20.0}}
RECORD: dict[str, Any] = {
    "run": "abc",
    "log": "synthetic:street",
    "preset": "demo",
    "report": "report.html",
    "config": {},
    "differs": {},
    "chunks": [{"chunk": 0, "stages": [STAGE]}],
}


def write_record(store: Path, run: str, content: bytes) -> Path:
    path = store / "runs" / run / "run.json"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"{}",
        b"\xff\xfe",
        b"[" * 100_000,
        json.dumps(RECORD | {"chunks": [{}]}).encode(),
        json.dumps(RECORD | {"log": None}).encode(),
        json.dumps(RECORD | {"chunks": "x"}).encode(),
    ],
)
def test_a_damaged_record_is_one_error_and_hides_no_other_run(content: bytes, tmp_path: Path) -> None:
    """Report: none found; case 25 of the list of odd logs (a store in which a file is damaged)."""
    write_record(tmp_path, "abc", json.dumps(RECORD).encode())
    damaged = write_record(tmp_path, "def", content)
    with pytest.raises(InputError, match="the record of a run is damaged") as caught:
        list_runs(str(tmp_path))
    assert caught.value.file == str(damaged)
    # The damaged one does not matter to a command about the other.
    assert list_runs(str(tmp_path), "ab") == [RECORD]
