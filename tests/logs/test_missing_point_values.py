"""A point without an intensity or a time keeps its place in every layout, and one finding names the column."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from genre_tasks.log_checks.check_log import check_log
from genre_tasks.logs.genre_layout.writer import write_genre_layout
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.point_values import fill_point_times
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog
from tests.logs.argoverse2_folder import to_ns, write_argoverse2
from tests.logs.kitti_folder import write_kitti
from tests.logs.nuscenes_folder import write_nuscenes
from tests.logs.pandaset_folder import edit_table
from tests.logs.waymo_folder import SEGMENT, write_waymo

FAKE = FakeLog(frame_count=4, camera_names=("front",), lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4)
# Rows without a place, without an intensity and, where the layout has times, without a time.
PLACE = 3
INTENSITY = slice(10, 14)
TIME = slice(20, 25)
CHANGED = (1, 2)
WORDS = ("missing_intensity", "missing_point_time")
NAN = float("nan")


def damage_pandaset(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    write_pandaset(log, folder / "002")
    for frame in changed:
        path = folder / f"002/lidar/{frame:02d}.pkl.gz"
        columns = {name: read_table(path).columns[name].astype(float) for name in ("y", "i", "t")}
        for name, rows in (("y", PLACE), ("i", INTENSITY), ("t", TIME)):
            columns[name][rows] = NAN
        edit_table(path, **columns)
    return f"pandaset:{folder / '002'}"


def damage_genre(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    write_genre_layout(log, folder / "log")
    text = (folder / "log/log.json").read_text()
    for frame in changed:
        with np.load(folder / f"log/lidar/{frame:06d}.npz") as archive:
            columns = {name: archive[name].tolist() for name in archive.files}
        for name, rows in (("y", PLACE), ("intensity", INTENSITY), ("time_s", TIME)):
            values = np.array(columns[name], dtype=object)
            # A null of Parquet, as tables of other tools have it.
            values[rows] = None
            columns[name] = values.tolist()
        pq.write_table(pa.table(columns), folder / f"log/lidar/{frame:06d}.parquet")
        text = text.replace(f"{frame:06d}.npz", f"{frame:06d}.parquet")
    (folder / "log/log.json").write_text(text)
    return f"genre:{folder / 'log'}"


def damage_rows(path: Path, width: int) -> None:
    """A file of rows of single precision, x, y, z and intensity first."""
    rows = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, width).copy()
    rows[PLACE, 1] = np.inf
    rows[INTENSITY, 3] = NAN
    path.write_bytes(rows.tobytes())


def damage_kitti(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    drive = write_kitti(log, folder)
    for frame in changed:
        damage_rows(drive / f"velodyne_points/data/{frame:010d}.bin", 4)
    return f"kitti:{drive}"


def damage_nuscenes(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    address = write_nuscenes(log, folder)
    for frame in changed:
        damage_rows(folder / f"samples/LIDAR_TOP/scene-0061-{frame}.pcd.bin", 5)
    return f"nuscenes:{address}"


def damage_waymo(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    address = write_waymo(log, folder)
    name = "[LiDARComponent].range_image_return1.values"
    path = folder / f"lidar/{SEGMENT}.parquet"
    table = pq.read_table(path)
    images = [np.array(values, np.float32).reshape(-1, 4) for values in table.column(name).to_pylist()]
    for frame in changed:
        images[frame][PLACE, 0] = np.inf
        images[frame][INTENSITY, 1] = NAN
    column = pa.array([image.ravel() for image in images], pa.list_(pa.float32()))
    pq.write_table(table.set_column(table.column_names.index(name), name, column), path)
    return f"waymo:{address}"


def damage_argoverse2(log: FakeLog, folder: Path, changed: tuple[int, ...]) -> str:
    write_argoverse2(log, folder / "log")
    for frame in changed:
        path = folder / f"log/sensors/lidar/{to_ns(log.frame_timestamp_s(frame))}.feather"
        columns = {name: np.array(values, float) for name, values in feather.read_table(path).to_pydict().items()}
        for name, rows in (("y", PLACE), ("intensity", INTENSITY), ("offset_ns", TIME)):
            columns[name][rows] = NAN
        feather.write_feather(pa.table(columns), path)
    return f"argoverse2:{folder / 'log'}"


WITH_TIMES = {"pandaset": ("i", "t"), "genre": ("intensity", "time_s"), "argoverse2": ("intensity", "offset_ns")}
LAYOUTS: dict[str, Callable[[FakeLog, Path, tuple[int, ...]], str]] = {
    "pandaset": damage_pandaset,
    "genre": damage_genre,
    "kitti": damage_kitti,
    "nuscenes": damage_nuscenes,
    "waymo": damage_waymo,
    "argoverse2": damage_argoverse2,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_only_a_missing_place_costs_a_point(layout: str, tmp_path: Path) -> None:
    expected = open_log(LAYOUTS[layout](FAKE, tmp_path / "sound", ()))
    log = open_log(LAYOUTS[layout](FAKE, tmp_path / "damaged", CHANGED))
    for frame in range(FAKE.frame_count):
        sound, found = expected.sweep(frame), log.sweep(frame)
        assert sound is not None and found is not None
        if frame not in CHANGED:
            np.testing.assert_array_equal(found.points_world, sound.points_world)
            np.testing.assert_array_equal(found.intensity, sound.intensity)
            continue
        stays = np.arange(len(sound.points_world)) != PLACE
        np.testing.assert_allclose(found.points_world, sound.points_world[stays], rtol=0, atol=1e-9)
        intensity = sound.intensity.copy()
        assert intensity[INTENSITY].min() > 0
        intensity[INTENSITY] = 0.0
        np.testing.assert_array_equal(found.intensity, intensity[stays])
        times = sound.timestamps_s.copy()
        if layout in WITH_TIMES:
            times[TIME] = log.frame_timestamp_s(frame)
        np.testing.assert_array_equal(found.timestamps_s, times[stays])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_finding_of_a_log_names_the_column(layout: str, tmp_path: Path) -> None:
    findings = check_log(open_log(LAYOUTS[layout](FAKE, tmp_path, CHANGED))).findings
    found = {finding.word: finding for finding in findings if finding.word in WORDS}
    intensity, time = WITH_TIMES.get(layout, ("intensity", None))
    assert set(found) == ({"missing_intensity"} | ({"missing_point_time"} if time else set()))
    assert all((finding.severity, finding.frames) == ("warning", CHANGED) for finding in found.values())
    assert f"4 points of sweep 1 have no finite {intensity}, which counts as 0" in found["missing_intensity"].message
    if time:
        message = f"5 points of sweep 1 have no finite {time}, which counts as the frame's time"
        assert message in found["missing_point_time"].message
    (unplaced,) = [finding for finding in findings if finding.word == "invalid_points"]
    assert unplaced.frames == CHANGED and unplaced.numbers == {"points": 1}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_sound_log_has_no_such_finding(layout: str, tmp_path: Path) -> None:
    log = open_log(LAYOUTS[layout](FAKE, tmp_path, ()))
    assert not [f for f in check_log(log).findings if f.word in (*WORDS, "invalid_points")]


def test_a_frame_without_a_time_lends_that_of_the_other_points() -> None:
    values, _ = fill_point_times(np.array([7.0, NAN, 9.0]), NAN, 0)
    assert values.tolist() == [7.0, 8.0, 9.0]
    values, _ = fill_point_times(np.array([NAN, NAN]), NAN, 0)
    assert values.tolist() == [0.0, 0.0]
