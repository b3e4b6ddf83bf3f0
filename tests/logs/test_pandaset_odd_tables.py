"""Tables of cuboids and sweeps as people have them: read by rule, or refused with file and column."""

from __future__ import annotations

import gzip
import pickle
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.pickle_reader import read_table
from tests.logs.pandaset_folder import cuboids, edit_table, findings, opened, write_table

START = 1557179160.5
DTYPES: dict[str, dict[str, str]] = {
    "categories": {"label": "category", "uuid": "category", "attributes.object_motion": "category"},
    "strings": {"label": "string", "uuid": "string"},
    "nullable": {"position.x": "Float64", "cuboids.sensor_id": "Int64", "stationary": "boolean"},
    "single": {"position.x": "float32", "yaw": "Float32"},
    "objects": {"position.x": "object", "stationary": "object", "cuboids.sensor_id": "object"},
    "arrow": {"position.x": "double[pyarrow]", "label": "string[pyarrow]", "cuboids.sensor_id": "int64[pyarrow]"},
}


def edit_frame(path: Path, change: Callable[[Any], Any]) -> None:
    """Replaces the DataFrame of a file by ``change(frame)``."""
    frame = pickle.loads(gzip.decompress(path.read_bytes()))
    path.write_bytes(gzip.compress(pickle.dumps(change(frame))))


MOVING_BOX = {"position.x": 2.5, "attributes.object_motion": "Moving"}


class TestCuboidColumns:
    @pytest.fixture
    def path(self, folder: Path) -> Path:
        shutil.rmtree(folder / "annotations")
        path = folder / "annotations/cuboids/00.pkl.gz"
        write_table(path, cuboids(MOVING_BOX, {**MOVING_BOX, "uuid": "b", "label": "Bus"}))
        return path

    @pytest.mark.parametrize("kind", DTYPES)
    def test_dtypes_of_pandas(self, folder: Path, path: Path, kind: str) -> None:
        """Report: pandas-dev/pandas#61763 (dtypes that come and go with the version of pandas)."""
        pytest.importorskip("pandas")
        if kind == "arrow":
            pytest.importorskip("pyarrow")
        expected = opened(folder).tracks()
        edit_frame(path, lambda table: table.astype(DTYPES[kind]))
        found = opened(folder).tracks()
        assert [(t.track_id, t.label, t.moving) for t in found] == [("a", "Car", True), ("b", "Bus", True)]
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one.world_SE3_box, other.world_SE3_box)

    def test_uuid_objects(self, folder: Path, path: Path) -> None:
        pytest.importorskip("pandas")
        names = [uuid.UUID(int=1), uuid.uuid1()]
        edit_frame(path, lambda table: table.assign(uuid=names))
        assert [track.track_id for track in opened(folder).tracks()] == [str(name) for name in names]

    def test_boxes_without_a_uuid_are_left_out(self, folder: Path, path: Path) -> None:
        edit_table(path, uuid=np.array([None, "b"], dtype=object))
        log = opened(folder)
        assert [track.track_id for track in log.tracks()] == ["b"]
        assert "has no uuid" in findings(log)["invalid_box"].message

    @pytest.mark.parametrize("value", [np.nan, None, "none"])
    def test_a_missing_sensor_is_no_sensor(self, folder: Path, path: Path, value: Any) -> None:
        edit_table(path, **{"cuboids.sensor_id": np.array([value, 0], dtype=object)})
        assert len(opened(folder).tracks()) == 2

    @pytest.mark.parametrize("still", [False, 0, "False", "false", 0.0])
    def test_ways_to_say_that_an_object_moves(self, folder: Path, path: Path, still: Any) -> None:
        motion = np.array([None, "MOVING"], dtype=object)
        edit_table(path, **{"attributes.object_motion": motion, "stationary": np.array([still, None], dtype=object)})
        assert [track.moving for track in opened(folder).tracks()] == [True, True]

    def test_text_in_the_place_of_numbers(self, folder: Path, path: Path) -> None:
        edit_table(path, yaw=np.array(["left", "right"], dtype=object))
        with pytest.raises(InputError, match="the column yaw is not numeric") as caught:
            opened(folder).tracks()
        assert (caught.value.file, caught.value.frame) == (str(path), 0)


class TestSweepColumns:
    def test_all_points_of_the_forward_sensor_are_used_and_named(self, folder: Path) -> None:
        """Report: scaleapi/pandaset-devkit#75 (what column d stands for)."""
        path = folder / "lidar/01.pkl.gz"
        rows = read_table(path).row_count
        edit_table(path, d=np.ones(rows, dtype=np.int64))
        log = opened(folder)
        sweep = log.sweep(1)
        assert sweep is not None and len(sweep.points_world) == rows
        found = findings(log)["other_lidar"]
        assert (found.severity, found.frames, found.numbers["points"]) == ("warning", (1,), rows)
        assert "d = 1" in found.message and "d = 0" in found.message

    def test_without_a_sensor_column_it_is_noted(self, folder: Path) -> None:
        edit_table(folder / "lidar/01.pkl.gz", d=None)
        log = opened(folder)
        assert log.sweep(1) is not None and findings(log)["no_sensor_column"].severity == "note"

    def test_names_in_capitals_are_named(self, folder: Path) -> None:
        path = folder / "lidar/01.pkl.gz"
        write_table(path, {name.upper(): values for name, values in read_table(path).columns.items()})
        with pytest.raises(InputError, match=r"lacks the columns x, y, z, i, t; it has X, Y, Z, I, T, D") as caught:
            opened(folder).sweep(1)
        assert "small letters" in caught.value.remedy

    @pytest.mark.parametrize("scale", [1.0, 65535.0])
    def test_scales_of_intensity(self, folder: Path, scale: float) -> None:
        """Report: none found; case 21 of the list of odd logs."""
        path = folder / "lidar/01.pkl.gz"
        expected = opened(folder).sweep(1)
        assert expected is not None
        values = np.linspace(0, 1, len(expected.intensity))
        edit_table(path, i=values * scale)
        log = opened(folder)
        found = log.sweep(1)
        assert found is not None and findings(log)["intensity_scale"].severity == "note"
        np.testing.assert_allclose(found.intensity, values, atol=1e-6)

    @pytest.mark.parametrize("dtype", ["float32", "Float64", "object", "category", "string"])
    def test_dtypes_of_pandas(self, folder: Path, dtype: str) -> None:
        pytest.importorskip("pandas")
        path = folder / "lidar/01.pkl.gz"
        expected = opened(folder).sweep(1)
        edit_frame(path, lambda table: table.astype({"x": dtype, "d": "Int64"}))
        found = opened(folder).sweep(1)
        assert found is not None and expected is not None
        np.testing.assert_allclose(found.points_world, expected.points_world, rtol=1e-6)

    def test_times_of_pandas(self, folder: Path) -> None:
        pd = pytest.importorskip("pandas")
        edit_frame(folder / "lidar/01.pkl.gz", lambda table: table.assign(t=pd.Timestamp(START, unit="s")))
        sweep = opened(folder).sweep(1)
        assert sweep is not None
        np.testing.assert_allclose(sweep.timestamps_s, START, rtol=0, atol=1e-6)

    @pytest.mark.parametrize(
        ("data", "words"),
        [
            (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
            (b"", "empty"),
            (b"<!doctype html>", "web page"),
            (b"BZh9damaged", "unpacked"),
            (b"\xfd7zXZ\0damaged", "unpacked"),
            (b"PK\x03\x04damaged", "unpacked"),
            (b"\x28\xb5\x2f\xfd", "Zstandard"),
        ],
    )
    def test_files_that_are_no_tables(self, folder: Path, data: bytes, words: str) -> None:
        """Report: git-lfs/git-lfs#4830."""
        path = folder / "lidar/01.pkl.gz"
        path.write_bytes(data)
        with pytest.raises(InputError, match=words) as caught:
            opened(folder).sweep(1)
        assert (caught.value.file, caught.value.frame) == (str(path), 1)
