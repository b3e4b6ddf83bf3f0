"""Paths in files: Parquet and JSON, poses and relative ones, and an error for everything that is wrong with one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flows.simulation.path_file import read_path_file, tabulate_path
from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.ego_paths.behaviours import plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.path_marks import mark_path
from genre_tasks.errors import InputError
from tests.ego_paths.drives import drive

RECORDED = drive(40, lambda t: np.full_like(t, 8.0), lambda s: np.full_like(s, 0.005), origin=(100.0, 5.0, 2.0))
SWERVE = plan_behaviour("swerve", RECORDED, SimulateConfig(), start_offset_m=1.0)


def write(path: Path, columns: dict[str, Any]) -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    else:
        path.write_text(
            json.dumps([dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)])
        )
    return path


def as_lists(path: EgoPath) -> dict[str, list[float]]:
    return {name: values.tolist() for name, values in tabulate_path(path).items()}


@pytest.mark.parametrize("kind", ["parquet", "json"])
@pytest.mark.parametrize("left_out", [None, "time_s", "frame"])
def test_a_written_path_is_read_again(tmp_path: Path, kind: str, left_out: str | None) -> None:
    columns = {name: values for name, values in as_lists(SWERVE).items() if name != left_out}
    path = read_path_file(write(tmp_path / f"path.{kind}", columns), RECORDED)
    assert np.allclose(path.world_SE3_ego, SWERVE.world_SE3_ego, atol=1e-9)
    assert np.allclose(path.times_s, SWERVE.times_s, atol=1e-9)
    assert np.allclose(path.frames, SWERVE.frames, atol=1e-9)


def test_the_poses_of_a_rollout_are_a_path(tmp_path: Path) -> None:
    columns = as_lists(SWERVE)
    columns |= {"index": list(range(40)), "lateral_m": [0.0] * 40, "ahead_m": [0.0] * 40}
    columns |= {"reliable": [None] * 40, "outside_recording": [False] * 40, "collision": [None] * 40}  # type: ignore[dict-item]
    path = read_path_file(write(tmp_path / "poses.parquet", columns), RECORDED)
    assert np.allclose(path.world_SE3_ego, SWERVE.world_SE3_ego, atol=1e-9)


def test_a_relative_path_is_placed(tmp_path: Path) -> None:
    columns = {"frame": [10, 20, 30.5], "lateral_m": [3, 2, 1.0], "ahead_m": [0, 0.5, 0]}
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"poses": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values())]}))  # noqa: B905
    path = read_path_file(file, RECORDED)
    assert path.times_s == pytest.approx([0.0, 1.0, 2.05])
    marks = mark_path(path, RECORDED, 9, 9)
    assert marks.lateral_m == pytest.approx([3.0, 2.0, 1.0], abs=0.01)
    assert marks.ahead_m == pytest.approx([0.0, 0.5, 0.0], abs=0.01)


def _changed(**changes: Any) -> dict[str, Any]:
    """The swerve's columns with others in their place; ``None`` leaves a column out, a pair changes one row."""
    columns: dict[str, Any] = as_lists(SWERVE)
    for name, change in changes.items():
        if change is None:
            del columns[name]
        elif isinstance(change, tuple):
            columns[name][change[0]] = change[1]
        else:
            columns[name] = change
    return columns


@pytest.mark.parametrize(
    ("columns", "problem", "remedy"),
    [
        ({"frame": [], "lateral_m": [], "ahead_m": []}, "a path without frames: the file has 0 rows", "a row for each"),
        (_changed(qx=None), "no column qx", "qw, qx, qy, qz"),
        (_changed(frame=None, time_s=None), "neither time_s nor frame", "time_s or frame"),
        (_changed(speed=[0.0] * 40), "unknown column 'speed'", "A path has"),
        ({"frame": [0, 1], "lateral": [0, 1], "ahead_m": [0, 1]}, "column 'lateral'", "Did you mean 'lateral_m'"),
        (_changed(x=(7, float("nan"))), "x is nan in row 7", "finite"),
        (_changed(y=(39, None)), "y is None in row 39", "finite"),
        (_changed(time_s=(5, 0.4)), "time_s 0.4 in row 5 (from 0) follows 0.4", "rise"),
        (_changed(frame=(5, 3.0)), "frame 3 in row 5 (from 0) follows 4", "no frame fall"),
        (_changed(frame=(5, 4.0), time_s=None), "frame 4 in row 5 (from 0) follows 4", "state time_s"),
        (
            _changed(frame=(39, 40.0)),
            "frame 40 in row 39 (from 0) is outside of the log's frames 0 to 39",
            "more chunks",
        ),
        (
            _changed(time_s=(39, 4.2), frame=None),
            "time_s 4.2 in row 39 (from 0) is outside of the log's 0 to 3.90 s",
            "",
        ),
        (_changed(qw=[0.0] * 40, qz=[0.0] * 40), "the quaternion in row 0 (from 0) has the length 0", "unit"),
        (_changed(x=[5e6] * 40), "row 0 (from 0) is 4999.", "the log's world"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, columns: dict[str, Any], problem: str, remedy: str) -> None:
    file = write(tmp_path / "path.parquet", columns)
    with pytest.raises(InputError) as refused:
        read_path_file(file, RECORDED)
    assert problem in refused.value.problem
    assert remedy in refused.value.remedy
    assert refused.value.file == str(file)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("path.csv", "frame,x", "a .parquet or a .json file"),
        ("missing.json", None, "cannot be read"),
        ("path.json", "[", "cannot be read"),
        ("path.parquet", "PAR1", "cannot be read"),
        ("path.json", "[]", "a path without frames"),
        ("path.json", "[1, 2]", "no list of objects"),
        ("path.json", '{"rows": []}', "no list of objects"),
        ("path.json", '[{"frame": 0, "lateral_m": 1, "ahead_m": 0}, {"frame": 1, "ahead_m": 0}]', "row 1 (from 0)"),
        ("path.json", '[{"frame": true, "lateral_m": 1, "ahead_m": 0}]', "frame is True in row 0"),
        ("path.json", '[{"frame": 1e999, "lateral_m": 1, "ahead_m": 0}]', "frame is inf in row 0"),
    ],
)
def test_files_that_are_no_path_are_named(tmp_path: Path, name: str, text: str | None, problem: str) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError) as refused:
        read_path_file(file, RECORDED)
    assert problem in refused.value.problem
    assert refused.value.file == str(file)


def test_frames_between_chunks_that_do_not_follow_each_other_are_refused(tmp_path: Path) -> None:
    gap = np.r_[0:10, 30:40]
    recorded = EgoPath(RECORDED.times_s[gap], RECORDED.frames[gap], RECORDED.world_SE3_ego[gap])
    file = write(tmp_path / "path.json", {"frame": [8, 9, 20], "lateral_m": [0, 0, 0], "ahead_m": [0, 0, 0]})
    with pytest.raises(InputError, match="frame 20 in row 2"):
        read_path_file(file, recorded)
    # The same moments by their times.
    file = write(tmp_path / "path.json", {"time_s": [0.8, 0.9, 2.0], "lateral_m": [0, 0, 0], "ahead_m": [0, 0, 0]})
    with pytest.raises(InputError, match=r"time_s 2 in row 2 .* do not follow each other"):
        read_path_file(file, recorded)


def test_times_in_other_units_are_refused(tmp_path: Path) -> None:
    nanoseconds = (1e8 * np.arange(20)).tolist()
    columns = {"frame": list(range(20)), "time_s": nanoseconds, "lateral_m": [0] * 20, "ahead_m": [0] * 20}
    with pytest.raises(InputError, match=r"time_s spans 1.9e\+09 s.*in seconds"):
        read_path_file(write(tmp_path / "path.json", columns), RECORDED)
