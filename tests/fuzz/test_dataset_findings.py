"""What the fuzzers have found in readers of datasets stays mended: docs/results/fuzz.md lists it."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from benchmarks.fuzz import fuzz_log_folders
from genre_tasks.errors import InputError
from genre_tasks.logs.genre_layout.sweep_files import read_sweep, write_sweep
from genre_tasks.logs.labelled_boxes import MAX_BOXES
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Sweep


def _write_sweep(path: Path) -> Path:
    points = np.random.default_rng(0).normal(size=(2000, 3))
    write_sweep(path, Sweep(points, np.zeros(2000, np.float32), np.zeros(2000)))
    return path


def test_an_npz_whose_compressed_bytes_are_damaged(tmp_path: Path) -> None:
    path = _write_sweep(tmp_path / "0.npz")
    data = bytearray(path.read_bytes())
    refused = 0
    for at in range(60, 4000, 40):
        damaged = bytearray(data)
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot be read"):
            read_sweep(path, 0.0, "log", 0)
        refused += 1
    assert refused > 90


def test_an_npz_whose_header_claims_more_than_there_is(tmp_path: Path) -> None:
    path = tmp_path / "0.npz"
    sink = io.BytesIO()
    np.lib.format.write_array(sink, np.zeros(3))
    claim = sink.getvalue().replace(b"(3,), }          ", b"(900000000000,), }")[: len(sink.getvalue())]
    assert b"900000000000" in claim
    with zipfile.ZipFile(path, "w") as archive:
        for name in "xyz":
            archive.writestr(f"{name}.npy", claim)
    with pytest.raises(InputError, match="another size than its header says"):
        read_sweep(path, 0.0, "log", 0)


@pytest.mark.parametrize("rows", [MAX_BOXES + 1, 2_000_000])
def test_millions_of_boxes_in_a_small_feather_file(tmp_path: Path, rows: int) -> None:
    fuzz_log_folders.write_argoverse2_folder(tmp_path)
    path = tmp_path / "annotations.feather"
    table = feather.read_table(path).take(np.zeros(rows, np.int64))
    feather.write_feather(table, path, compression="zstd")
    assert path.stat().st_size < 1 << 24
    with pytest.raises(InputError, match="more than") as caught:
        open_log(f"argoverse2:{tmp_path}").tracks()
    assert caught.value.file == str(path)


def test_millions_of_boxes_in_a_small_parquet_file(tmp_path: Path) -> None:
    fuzz_log_folders.write_waymo_folder(tmp_path)
    path = tmp_path / f"lidar_box/{fuzz_log_folders.SEGMENT}.parquet"
    pq.write_table(pq.read_table(path).take(np.zeros(2_000_000, np.int64)), path)
    with pytest.raises(InputError, match="2000000 boxes"):
        open_log(f"waymo:{tmp_path}/{fuzz_log_folders.SEGMENT}").tracks()


@pytest.mark.parametrize("kind", [pa.string(), pa.list_(pa.string()), pa.list_(pa.float32(), 1)])
@pytest.mark.parametrize(
    ("component", "field"),
    [
        ("lidar", "[LiDARComponent].range_image_return1.values"),
        ("lidar", "[LiDARComponent].range_image_return1.shape"),
        ("lidar_pose", "[LiDARPoseComponent].range_image_return1.values"),
        ("lidar_calibration", "[LiDARCalibrationComponent].beam_inclination.values"),
    ],
)
def test_lists_that_hold_something_else(tmp_path: Path, kind: pa.DataType, component: str, field: str) -> None:
    fuzz_log_folders.write_waymo_folder(tmp_path)
    path = tmp_path / f"{component}/{fuzz_log_folders.SEGMENT}.parquet"
    table = pq.read_table(path)
    value = "x" if pa.types.is_string(kind) else ["x"] if pa.types.is_string(kind.value_type) else [float("nan")]
    values = pa.array([value] * table.num_rows, kind)
    pq.write_table(table.set_column(table.column_names.index(field), field, values), path)
    with pytest.raises(InputError) as caught:
        open_log(f"waymo:{tmp_path}/{fuzz_log_folders.SEGMENT}").sweep(0)
    assert component in str(caught.value.file) or "rows" in caught.value.problem


def test_no_bit_of_a_footer_ends_the_process(tmp_path: Path) -> None:
    """PyArrow calls std::terminate for statistics of sizes that do not fit the schema."""
    command = [sys.executable, "-m", "tests.fuzz.footer_flips", str(tmp_path / "table.parquet")]
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    read, refused = map(int, done.stdout.split())
    assert min(read, refused) > 300


def test_boxes_without_size(tmp_path: Path) -> None:
    fuzz_log_folders.write_kitti_folder(tmp_path)
    drive = tmp_path / fuzz_log_folders.DRIVE
    tracklets = drive / "tracklet_labels.xml"
    tracklets.write_text(tracklets.read_text().replace("<w>1.8</w>", "<w>0</w>"))
    with pytest.raises(InputError, match=r"pose 0 of tracklet 0. has a size that is not positive"):
        open_log(f"kitti:{drive}").tracks()
    labels = tmp_path / "labels.txt"
    labels.write_text(labels.read_text().replace("1.8 4.0", "1.8 -4.0"))
    with pytest.raises(InputError, match=r"labels.txt, line 2. has a size that is not positive") as caught:
        open_log(f"kitti:{drive}?labels={labels}").tracks()
    assert caught.value.file == str(labels)


@pytest.mark.parametrize("field", ["velocity.linear_velocity.x", "velocity.angular_velocity.z"])
def test_velocities_out_of_all_proportion(tmp_path: Path, field: str) -> None:
    fuzz_log_folders.write_waymo_folder(tmp_path)
    path = tmp_path / f"camera_image/{fuzz_log_folders.SEGMENT}.parquet"
    table = pq.read_table(path)
    name = f"[CameraImageComponent].{field}"
    pq.write_table(table.set_column(table.column_names.index(name), name, pa.array([1e300, 0.0])), path)
    with pytest.raises(InputError, match="out of all proportion"):
        open_log(f"waymo:{tmp_path}/{fuzz_log_folders.SEGMENT}")
