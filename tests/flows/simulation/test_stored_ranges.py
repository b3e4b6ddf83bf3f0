"""Reliable ranges in a run's folder: a damaged file is computed again and replaced, and a sound one is read."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flows.simulation import stored_ranges
from flows.simulation.run_scenes import RunScenes
from flows.simulation.stored_ranges import SideRange, find_side_ranges
from genre_tasks.progress import silent

COMPUTED = SideRange(2.0, 3.0)


class OneChunkRun:
    """What a search for ranges asks of a ``RunScenes``."""

    chunk_numbers = (0,)

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def payload_digests(self) -> dict[str, str]:
        return {"chunk 0 ingest": "5f41", "chunk 0 initial": "c0de"}

    def load(self, number: int) -> Any:
        return SimpleNamespace(chunk=None, scene=None)

    def push_folder(self) -> None:
        pass


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """An entry for each range that was computed."""
    calls: list[int] = []

    def estimate(*values: object) -> SideRange:
        calls.append(len(calls))
        return COMPUTED

    monkeypatch.setattr(stored_ranges, "estimate_reliable_range", estimate)
    return calls


def find(folder: Path) -> SideRange:
    return find_side_ranges(cast(RunScenes, OneChunkRun(folder)), silent)[0]


def test_a_range_is_computed_once(tmp_path: Path, computed: list[int]) -> None:
    assert find(tmp_path) == find(tmp_path) == COMPUTED and len(computed) == 1
    (file,) = tmp_path.glob("ranges/*.json")
    file.write_text(json.dumps({"left_m": 7, "right_m": 0.5}))
    assert find(tmp_path) == SideRange(7.0, 0.5) and len(computed) == 1


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b'{"left_m": 1.0, "rig',
        b"\xff\xfe",
        b"[1.0, 2.0]",
        b'{"left_m": 1.0}',
        b'{"left_m": NaN, "right_m": 1.0}',
        b'{"left_m": 1e999, "right_m": 1.0}',
        b'{"left_m": "1.0", "right_m": 1.0}',
        b'{"left_m": true, "right_m": 1.0}',
        b'{"left_m": -1.0, "right_m": 1.0}',
        b"[" * 100_000,
    ],
)
def test_a_damaged_range_is_computed_again(tmp_path: Path, computed: list[int], damaged: bytes) -> None:
    find(tmp_path)
    (file,) = tmp_path.glob("ranges/*.json")
    sound = file.read_bytes()
    file.write_bytes(damaged)
    assert find(tmp_path) == COMPUTED and len(computed) == 2
    assert file.read_bytes() == sound
    assert find(tmp_path) == COMPUTED and len(computed) == 2


def test_what_cannot_be_replaced_is_computed_each_time(tmp_path: Path, computed: list[int]) -> None:
    find(tmp_path)
    (file,) = tmp_path.glob("ranges/*.json")
    file.unlink()
    (file / "inside").mkdir(parents=True)
    assert find(tmp_path) == find(tmp_path) == COMPUTED and len(computed) == 3
