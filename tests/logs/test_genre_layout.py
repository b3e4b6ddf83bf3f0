"""The minimal layout: any log comes back as it was written, and what is broken is an error that names the file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from plyfile import PlyData, PlyElement

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.logs.genre_layout.writer import write_genre_layout
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera, DrivingLog
from genre_tasks.stages.ingest import ingest
from tests.fakes import FakeLog
from tests.log_checks.edited_log import EditedLog
from tests.logs.kitti_folder import write_kitti

FAKE = FakeLog(frame_count=5, lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4, track_every=2)
FAKE = FAKE.with_(missing_images=frozenset({("left", 1)}), missing_sweeps=frozenset({3}))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_genre_layout(FAKE, tmp_path_factory.mktemp("genre") / "007")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A log for a test to break."""
    shutil.copytree(written, tmp_path / "007")
    return tmp_path / "007"


def assert_same_log(log: DrivingLog, expected: DrivingLog, atol: float = 0.0) -> None:
    """All that a reconstruction reads."""
    assert log.cameras == expected.cameras
    assert log.frame_count == expected.frame_count
    for frame in range(log.frame_count):
        assert log.frame_timestamp_s(frame) == expected.frame_timestamp_s(frame)
        np.testing.assert_allclose(log.world_SE3_lidar(frame), expected.world_SE3_lidar(frame), rtol=0, atol=atol)
        for camera in log.cameras:
            pose = log.world_SE3_camera(camera.name, frame)
            np.testing.assert_allclose(pose, expected.world_SE3_camera(camera.name, frame), rtol=0, atol=atol)
            assert log.camera_timestamp_s(camera.name, frame) == expected.camera_timestamp_s(camera.name, frame)
            assert log.image_bytes(camera.name, frame) == expected.image_bytes(camera.name, frame)
        sweep, expected_sweep = log.sweep(frame), expected.sweep(frame)
        assert (sweep is None) == (expected_sweep is None)
        if sweep is not None and expected_sweep is not None:
            np.testing.assert_array_equal(sweep.points_world, expected_sweep.points_world)
            np.testing.assert_array_equal(sweep.timestamps_s, expected_sweep.timestamps_s)
            np.testing.assert_allclose(sweep.intensity, expected_sweep.intensity, atol=1e-7)
    tracks = {track.track_id: track for track in log.tracks()}
    assert len(tracks) == len(expected.tracks())
    for track in expected.tracks():
        found = tracks[track.track_id]
        assert (found.label, found.size_m, found.moving) == (track.label, track.size_m, track.moving)
        np.testing.assert_array_equal(found.frames, track.frames)
        np.testing.assert_allclose(found.world_SE3_box, track.world_SE3_box, atol=1e-12)


def test_a_written_log_comes_back(written: Path) -> None:
    assert_same_log(open_log(f"genre:{written}"), FAKE)


def test_the_same_log_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    again = write_genre_layout(FAKE, tmp_path / "again")
    names = sorted(path.relative_to(again).as_posix() for path in again.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(written).as_posix() for path in written.rglob("*") if path.is_file())
    for name in names:
        assert (again / name).read_bytes() == (written / name).read_bytes(), name


def test_pandaset_to_genre_to_pandaset(tmp_path: Path) -> None:
    first = open_log(f"pandaset:{write_pandaset(FAKE, tmp_path / 'first')}")
    between = open_log(f"genre:{write_genre_layout(first, tmp_path / 'between')}")
    assert_same_log(between, first)
    second = open_log(f"pandaset:{write_pandaset(between, tmp_path / 'second')}")
    assert_same_log(second, first, atol=1e-15)


def test_kitti_to_genre(tmp_path: Path) -> None:
    fake = FakeLog(frame_count=4, camera_names=("front",), lidar_azimuths=60, lidar_rings=8)
    kitti = open_log(f"kitti:{write_kitti(fake, tmp_path)}")
    assert_same_log(open_log(f"genre:{write_genre_layout(kitti, tmp_path / 'genre')}"), kitti)


@pytest.mark.parametrize("suffix", [".parquet", ".ply"])
def test_sweeps_of_other_formats(folder: Path, suffix: str) -> None:
    expected = FAKE.sweep(0)
    columns = {name: expected.points_world[:, k] for k, name in enumerate("xyz")}
    path = folder / f"lidar/other{suffix}"
    if suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    else:
        rows = np.rec.fromarrays(list(columns.values()), names=list(columns))
        PlyData([PlyElement.describe(np.asarray(rows), "vertex")]).write(path)
    _change(folder, lambda values: values["frames"][0].update(sweep=f"lidar/other{suffix}"))

    sweep = open_log(f"genre:{folder}").sweep(0)
    np.testing.assert_array_equal(sweep.points_world, expected.points_world)
    # What a file does not say.
    assert (sweep.intensity == 0).all()
    assert (sweep.timestamps_s == FAKE.frame_timestamp_s(0)).all()


def test_rotations_of_few_digits_are_made_sound(folder: Path) -> None:
    pose = np.round(FAKE.world_SE3_lidar(2), 4)
    _change(folder, lambda values: values["frames"][2].update(lidar_pose=pose.tolist()))
    found = open_log(f"genre:{folder}").world_SE3_lidar(2)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found, pose, atol=1e-3)


def _change(folder: Path, change: Any) -> None:
    values = json.loads((folder / "log.json").read_text())
    change(values)
    (folder / "log.json").write_text(json.dumps(values))


def _read_all(folder: Path) -> None:
    log = open_log(f"genre:{folder}")
    log.tracks()
    for frame in range(log.frame_count):
        log.frame_timestamp_s(frame)
        log.world_SE3_lidar(frame)
        log.sweep(frame)
        for camera in log.cameras:
            log.world_SE3_camera(camera.name, frame)
            log.camera_timestamp_s(camera.name, frame)
            log.image_bytes(camera.name, frame)


SHEAR = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
BROKEN = {
    "another format": (lambda v: v.update(format="nuscenes"), "the format is 'nuscenes'"),
    "a later version": (lambda v: v.update(version=2), "the version is 2"),
    "no cameras": (lambda v: v.update(cameras={}), "no cameras"),
    "a camera of text": (lambda v: v["cameras"].update(front="wide"), "camera front is no object"),
    "a name that is a path": (lambda v: v["cameras"].update({"../x": v["cameras"]["front"]}), "no name of a camera"),
    "a name of dots": (lambda v: v["cameras"].update({"..": v["cameras"]["front"]}), "no name of a camera"),
    "no focal length": (lambda v: v["cameras"]["front"].pop("fx_px"), "no finite number fx_px"),
    "a focal length of 400 digits": (lambda v: v["cameras"]["front"].update(fx_px=10**400), "no finite number fx_px"),
    "half a pixel": (lambda v: v["cameras"]["front"].update(width_px=95.5), "half a pixel"),
    "no frames": (lambda v: v.update(frames=[]), "no list of frames"),
    "a frame without a time": (lambda v: v["frames"][2].pop("time_s"), "frame 2 has no finite number time_s"),
    "a pose of three rows": (lambda v: v["frames"][1].update(lidar_pose=SHEAR[:3]), "lidar_pose of frame 1"),
    "a shear": (lambda v: v["frames"][1].update(lidar_pose=SHEAR), "no rotation"),
    "no camera pose": (lambda v: v["frames"][0]["images"]["left"].pop("pose"), "pose of left in frame 0"),
    "an image elsewhere": (lambda v: v["frames"][0]["images"]["left"].update(file="../../x.png"), "leads out"),
    "an image that is not there": (lambda v: v["frames"][0]["images"]["left"].update(file="x.png"), "lacks a file"),
    "a position of two numbers": (lambda v: v["frames"][0].update(lidar_position=[1, 2]), "lidar_position of frame 0"),
    "a sweep that is not there": (lambda v: v["frames"][0].update(sweep="lidar/x.npz"), "no such sweep"),
    "a sweep of another format": (lambda v: v["frames"][0].update(sweep="log.json"), "no .json files"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_an_error_that_names_the_file(folder: Path, name: str) -> None:
    change, problem = BROKEN[name]
    _change(folder, change)
    with pytest.raises(InputError, match=problem) as caught:
        _read_all(folder)
    assert caught.value.file is not None
    assert caught.value.remedy


@pytest.mark.parametrize("name", ["lidar/000000.npz", "boxes.parquet", "log.json"])
@pytest.mark.parametrize("part", [0.0, 0.5, 0.95])
def test_cut_files(folder: Path, name: str, part: float) -> None:
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: int(part * len(data))])
    with pytest.raises(InputError) as caught:
        _read_all(folder)
    assert Path(caught.value.file).name == Path(name).name


def _boxes(**changes: Any) -> Any:
    def change(columns: dict[str, list[Any]]) -> None:
        for name, (row, value) in changes.items():
            columns[name][row] = value

    return change


BROKEN_BOXES = {
    "a column is missing": (lambda columns: columns.pop("qw"), "lack the columns qw"),
    "a later frame": (_boxes(frame=(0, 99)), "row 0 is of frame 99"),
    "moving as text": (
        lambda columns: columns.update(moving=["False"] * len(columns["x"])),
        "moving of row 0 is 'False'",
    ),
    "moving as digits": (lambda columns: columns.update(moving=["0"] * len(columns["x"])), "moving of row 0 is '0'"),
    "no object": (_boxes(track_id=(1, None)), "row 1 has no track_id"),
    "words": (lambda columns: columns.update(x=["here"] * len(columns["x"])), "something else than numbers"),
}


@pytest.mark.parametrize("name", BROKEN_BOXES)
def test_broken_boxes(folder: Path, name: str) -> None:
    change, problem = BROKEN_BOXES[name]
    columns = pq.read_table(folder / "boxes.parquet").to_pydict()
    change(columns)
    pq.write_table(pa.table(columns), folder / "boxes.parquet")
    with pytest.raises(InputError, match=problem):
        open_log(f"genre:{folder}").tracks()


BAD_BOXES = {
    "no size": (lambda columns, row: columns["width"].__setitem__(row, 0.0), "a size that is not positive"),
    "no place": (lambda columns, row: columns["x"].__setitem__(row, float("nan")), "is not finite"),
    "a null": (lambda columns, row: columns["z"].__setitem__(row, None), "is not finite"),
    "no direction": (
        lambda columns, row: [columns[name].__setitem__(row, 0.0) for name in ("qw", "qx", "qy", "qz")],
        "has a quaternion of zeros",
    ),
}


def test_keys_that_mean_nothing_are_named(folder: Path) -> None:
    def misspell(values: dict[str, Any]) -> None:
        values["comment"] = "a key of one's own"
        values["cameras"]["front"]["readouts"] = 0.03
        for frame in values["frames"]:
            frame["images"]["frnt"] = frame["images"].pop("front")

    _change(folder, misspell)
    found = [finding for finding in open_log(f"genre:{folder}").findings() if finding.word == "unknown_key"]
    assert [(finding.severity, finding.message.split("'")[1]) for finding in found] == [
        ("note", "comment"),
        ("warning", "readouts"),
        ("warning", "frnt"),
    ]
    assert found[2].remedy == "Did you mean 'front'?" and "frame 0" in found[2].message


def test_of_two_boxes_of_one_object_in_a_frame_the_first_sound_one_counts(folder: Path) -> None:
    columns = pq.read_table(folder / "boxes.parquet").to_pydict()
    sound = open_log(f"genre:{folder}").tracks()
    rows = [0, 0, 0, *range(1, len(columns["x"]))]
    repeated = {name: [values[row] for row in rows] for name, values in columns.items()}
    repeated["width"][0] = 0.0
    repeated["x"][2] += 50
    pq.write_table(pa.table(repeated), folder / "boxes.parquet")
    log = open_log(f"genre:{folder}")
    for track, expected in zip(log.tracks(), sound, strict=True):
        assert np.array_equal(track.world_SE3_box, expected.world_SE3_box)
    (found,) = [finding for finding in check_log(log).findings if finding.word == "repeated_box_id"]
    assert found.frames == (columns["frame"][0],) and found.message.startswith("1 box of frame")


@pytest.mark.parametrize("name", BAD_BOXES)
def test_a_bad_box_is_left_out_alone(folder: Path, name: str) -> None:
    change, problem = BAD_BOXES[name]
    columns = pq.read_table(folder / "boxes.parquet").to_pydict()
    change(columns, 1)
    pq.write_table(pa.table(columns), folder / "boxes.parquet")
    log = open_log(f"genre:{folder}")
    assert sum(len(track.frames) for track in log.tracks()) == len(columns["x"]) - 1
    (found,) = [finding for finding in check_log(log).findings if finding.word == "invalid_box"]
    frame = columns["frame"][1]
    assert found.frames == (frame,) and problem in found.message
    assert f"{columns['track_id'][1]} in frame {frame}" in found.message
    for row in range(len(columns["x"])):
        change(columns, row)
    pq.write_table(pa.table(columns), folder / "boxes.parquet")
    with pytest.raises(InputError, match=f"all {len(columns['x'])} boxes are bad: the first one .*{problem}"):
        open_log(f"genre:{folder}").tracks()


def test_moving_may_be_written_as_0_and_1(folder: Path) -> None:
    columns = pq.read_table(folder / "boxes.parquet").to_pydict()
    columns["moving"] = [int(value) for value in columns["moving"]]
    pq.write_table(pa.table(columns), folder / "boxes.parquet")
    assert_same_log(open_log(f"genre:{folder}"), FAKE)


def test_many_boxes_are_read(folder: Path) -> None:
    columns = pq.read_table(folder / "boxes.parquet").slice(0, 1).to_pydict()
    many = {name: values * 10_000 for name, values in columns.items()}
    many["track_id"] = [f"object-{index}" for index in range(10_000)]
    pq.write_table(pa.table(many), folder / "boxes.parquet")
    assert len(open_log(f"genre:{folder}").tracks()) == 10_000


def test_a_large_sweep_is_read_and_a_huge_one_refused(folder: Path) -> None:
    for count, allowed in ((2_000_000, True), (30_000_000, False)):
        path = folder / "lidar/large.parquet"
        # Zeros take next to no file.
        batch = pa.table({name: np.zeros(10_000_000 if not allowed else count, np.float32) for name in "xyz"})
        with pq.ParquetWriter(path, batch.schema) as writer:
            for _ in range(max(1, count // 10_000_000)):
                writer.write_table(batch)
        _change(folder, lambda values: values["frames"][0].update(sweep="lidar/large.parquet"))
        if allowed:
            assert len(open_log(f"genre:{folder}").sweep(0).points_world) == count
        else:
            with pytest.raises(InputError, match="MiB of memory"):
                open_log(f"genre:{folder}").sweep(0)


def test_intensities_of_another_scale_are_named_once(folder: Path) -> None:
    count = 300
    table = pa.table({name: np.ones(count, np.float32) for name in "xyz"} | {"intensity": np.arange(count) % 256.0})
    pq.write_table(table, folder / "lidar/wide.parquet")
    _change(folder, lambda values: [frame.update(sweep="lidar/wide.parquet") for frame in values["frames"][:3]])
    (finding,) = [f for f in check_log(open_log(f"genre:{folder}")).findings if f.word == "intensity_scale"]
    assert finding.severity == "warning" and finding.numbers["largest"] == 255 and "0 to 1" in finding.remedy


def test_a_folder_above_names_its_logs(folder: Path) -> None:
    with pytest.raises(InputError, match=r"no log\.json") as caught:
        open_log(f"genre:{folder.parent}")
    assert "007" in caught.value.remedy


def test_every_file_that_is_read_counts(folder: Path) -> None:
    digest = open_log(f"genre:{folder}").digest()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        data = path.read_bytes()
        path.write_bytes(data + b"\n")
        assert open_log(f"genre:{folder}").digest() != digest, path
        path.write_bytes(data)
    (folder / "notes.txt").write_text("nothing")
    assert open_log(f"genre:{folder}").digest() == digest


def test_an_entry_without_sense_costs_its_frame_and_not_the_log(folder: Path) -> None:
    _change(folder, lambda values: values["frames"][2]["images"].update(front=None))
    log = open_log(f"genre:{folder}")
    assert log.digest() and log.image_bytes("front", 1) is not None
    with pytest.raises(InputError, match="front of frame 2"):
        log.image_bytes("front", 2)


def test_a_camera_that_is_slower_is_mounted_as_at_the_nearest_frame(folder: Path, tmp_path: Path) -> None:
    def drop(values: dict[str, Any]) -> None:
        for frame in (0, 2, 3):
            del values["frames"][frame]["images"]["left"]

    _change(folder, drop)
    log = open_log(f"genre:{folder}")
    for frame in range(log.frame_count):
        np.testing.assert_allclose(
            log.world_SE3_camera("left", frame), FAKE.world_SE3_camera("left", frame), rtol=0, atol=1e-9
        )
    written = open_log(f"genre:{write_genre_layout(log, tmp_path / 'converted')}")
    assert written.image_bytes("left", 2) is None
    assert written.image_bytes("left", 4) == FAKE.image_bytes("left", 4)


def test_an_image_with_a_time_needs_none_of_its_frame(folder: Path) -> None:
    _change(folder, lambda values: values["frames"][2].pop("time_s"))
    assert open_log(f"genre:{folder}").camera_timestamp_s("front", 2) == FAKE.camera_timestamp_s("front", 2)


@pytest.mark.parametrize("change", [lambda frame: frame.pop("time_s"), lambda frame: frame.update(time_s=float("nan"))])
def test_the_check_reports_a_frame_without_a_time(folder: Path, change: Any) -> None:
    _change(folder, lambda values: change(values["frames"][2]))
    check = check_log(open_log(f"genre:{folder}"))
    (finding,) = [finding for finding in check.findings if finding.word == "missing_timestamp"]
    assert finding.frames == (2,) and "frame 2 has no finite number time_s" in finding.message


def test_a_first_frame_without_a_time_costs_its_chunk_alone(folder: Path) -> None:
    def drop(values: dict[str, Any]) -> None:
        for frame in values["frames"]:
            for image in frame["images"].values():
                image.pop("time_s", None)
        values["frames"][0].pop("time_s")

    _change(folder, drop)
    log = open_log(f"genre:{folder}")
    assert [finding.word for finding in check_log(log).findings if finding.severity == "fatal"] == []
    config = IngestConfig(chunk_frames=2, source_every=1, width_px=32, height_px=16)
    assert ingest(config, log, 1).frames == (2, 3)
    with pytest.raises(InputError, match="frame 0 has no finite number time_s"):
        ingest(config, log, 0)


@pytest.mark.parametrize("name", ["../../x", "/home/u/x", "..", "front camera", "a\\b", ""])
def test_a_name_that_is_no_folder_is_not_written(tmp_path: Path, name: str) -> None:
    log = EditedLog(FAKE, cameras=(Camera(name, FAKE.lens),))
    with pytest.raises(InputError, match="cannot be a folder's name") as caught:
        write_genre_layout(log, tmp_path / "logs/007")
    assert caught.value.remedy and list(tmp_path.iterdir()) == []
