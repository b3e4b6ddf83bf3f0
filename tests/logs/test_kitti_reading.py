"""KITTI's drives: the log that was written comes back, and what is broken is an error that names the file."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog
from tests.logs.kitti_folder import DRIVE, START_S, shifted_world, write_kitti, write_tracking_labels

FAKE = FakeLog(frame_count=6, camera_names=("front",), lidar_azimuths=60, lidar_rings=8, ego_yaw_rad=0.4)
REAL = Path(__file__).resolve().parents[3] / "shared/data/kitti/2011_09_26/2011_09_26_drive_0009_sync"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kitti")
    write_kitti(FAKE, folder)
    write_tracking_labels(FAKE, folder / "labels.txt")
    return folder


@pytest.fixture
def drive(written: Path, tmp_path: Path) -> Path:
    """A drive for a test to break."""
    shutil.copytree(written, tmp_path / "kitti")
    return tmp_path / "kitti" / DRIVE


@pytest.mark.parametrize("query", ["", "?labels={}"])
def test_a_written_log_comes_back(written: Path, query: str) -> None:
    log = open_log(f"kitti:{written / DRIVE}{query.format(written / 'labels.txt')}")
    shift = shifted_world(FAKE)
    (camera,) = log.cameras
    assert camera.name == "image_02"
    assert np.allclose(np.array(list(vars(camera.lens).values())[:4]), list(vars(FAKE.lens).values())[:4], atol=1e-9)
    for frame in range(FAKE.frame_count):
        assert log.frame_timestamp_s(frame) - START_S == pytest.approx(FAKE.frame_timestamp_s(frame), abs=1e-6)
        np.testing.assert_allclose(log.world_SE3_lidar(frame), shift @ FAKE.world_SE3_lidar(frame), atol=1e-6)
        expected = shift @ FAKE.world_SE3_camera("front", frame)
        np.testing.assert_allclose(log.world_SE3_camera("image_02", frame), expected, atol=1e-6)
        assert log.image_bytes("image_02", frame) == FAKE.image_bytes("front", frame)
        sweep = log.sweep(frame)
        assert sweep is not None
        points = FAKE.sweep(frame).points_world + shift[:3, 3]
        np.testing.assert_allclose(sweep.points_world, points, atol=1e-4)
    for track, expected_track in zip(log.tracks(), FAKE.tracks(), strict=True):
        assert track.label == expected_track.label
        assert track.moving == expected_track.moving
        np.testing.assert_array_equal(track.frames, expected_track.frames)
        np.testing.assert_allclose(track.size_m, expected_track.size_m)
        np.testing.assert_allclose(track.world_SE3_box, shift @ expected_track.world_SE3_box, atol=1e-6)


def test_images_between_two_poses_have_a_pose_between_them(drive: Path) -> None:
    path = drive / "image_02/timestamps.txt"
    # Half a frame later.
    lines = [line.replace(".", "#") for line in path.read_text().splitlines()]
    moved = [f"{line.partition('#')[0]}.{int(line.partition('#')[2]) + 50_000_000:09d}" for line in lines]
    path.write_text("\n".join(moved) + "\n")

    log = open_log(f"kitti:{drive}")
    before, after = (log.world_SE3_lidar(frame)[:3, 3] for frame in (2, 3))
    still = open_log(f"kitti:{drive}").world_SE3_camera("image_02", 2)[:3, 3]
    expected = (FAKE.world_SE3_camera("front", 2)[:3, 3] + FAKE.world_SE3_camera("front", 3)[:3, 3]) / 2
    np.testing.assert_allclose(still, expected + shifted_world(FAKE)[:3, 3], atol=1e-6)
    assert np.linalg.norm(after - before) > 0.1


def test_a_time_far_from_all_poses_has_none(drive: Path) -> None:
    path = drive / "image_02/timestamps.txt"
    # A clock that is two seconds ahead: the path beyond the last record would be made up.
    path.write_text(path.read_text().replace(":24.", ":26."))
    log = open_log(f"kitti:{drive}")
    with pytest.raises(InputError, match=r"pose is [12]\.\d+ s away, and 0.5 s") as caught:
        log.world_SE3_camera("image_02", 3)
    assert caught.value.file == str(drive / "oxts") and caught.value.frame == 3
    assert np.isfinite(log.world_SE3_lidar(3)).all()


def test_a_frame_without_a_pose_costs_its_own_boxes_alone(written: Path, drive: Path) -> None:
    path = drive / "image_02/timestamps.txt"
    lines = path.read_text().splitlines()
    wrong = lines[3].replace(":24.", ":26.")
    assert wrong != lines[3]
    path.write_text("\n".join([*lines[:3], wrong, *lines[4:]]) + "\n")
    log = open_log(f"kitti:{drive}?labels={written / 'labels.txt'}")
    for track, expected in zip(log.tracks(), FAKE.tracks(), strict=True):
        assert track.frames.tolist() == [frame for frame in expected.frames if frame != 3]
    (finding,) = [finding for finding in log.findings() if finding.word == "unreadable_cuboids"]
    assert finding.frames == (3,) and "0.5 s" in finding.message
    # Without any pose there is nothing to go on with.
    path.write_text("\n".join(line.replace(":24.", ":29.") for line in lines) + "\n")
    with pytest.raises(InputError, match=r"0\.5 s"):
        open_log(f"kitti:{drive}?labels={written / 'labels.txt'}").tracks()


def test_points_are_placed_by_their_own_time(drive: Path) -> None:
    still = open_log(f"kitti:{drive}").sweep(2)
    assert still is not None
    for name, shift_ns in (("start", -50_000_000), ("end", 50_000_000)):
        lines = (drive / "velodyne_points/timestamps.txt").read_text().splitlines()
        times = [int(line.partition(".")[2]) + shift_ns for line in lines]
        heads = [line.partition(".")[0] for line in lines]
        # The first turn begins before its second does.
        text = "".join(f"{head}.{max(time, 0):09d}\n" for head, time in zip(heads, times, strict=True))
        (drive / f"velodyne_points/timestamps_{name}.txt").write_text(text)

    moved = open_log(f"kitti:{drive}").sweep(2)
    assert moved is not None
    step = moved.points_world - still.points_world
    # A turn lasts a tenth of a second, and the vehicle goes 0.3 m in it: from half behind to half before.
    assert step[:, 0].min() == pytest.approx(-0.15, abs=0.01)
    assert step[:, 0].max() == pytest.approx(0.15, abs=0.01)
    assert np.ptp(moved.timestamps_s) == pytest.approx(0.1, abs=0.01)


def _resize(drive: Path, change: Callable[[Image.Image], Image.Image]) -> None:
    for path in (drive / "image_02/data").iterdir():
        change(Image.open(path)).save(path)


def test_images_at_half_the_size_of_the_calibration_scale_the_lens(drive: Path) -> None:
    _resize(drive, lambda image: image.resize((image.width // 2, image.height // 2)))
    log = open_log(f"kitti:{drive}")
    assert log.cameras[0].lens == FAKE.lens.resized(FAKE.width_px // 2, FAKE.height_px // 2)
    assert [(f.word, f.severity) for f in log.findings()] == [("resampled_images", "note")]


def test_images_that_were_cropped_are_named(drive: Path) -> None:
    _resize(drive, lambda image: image.crop((0, 8, image.width, image.height)))
    log = open_log(f"kitti:{drive}")
    assert log.cameras[0].lens == FAKE.lens
    (found,) = log.findings()
    assert (found.word, found.frames, found.camera) == ("odd_image_size", tuple(range(FAKE.frame_count)), "image_02")


@pytest.mark.parametrize("stated", [None, "0 0", "-1 64", "96 1e9"])
def test_without_a_stated_size_that_of_most_images_counts(drive: Path, stated: str | None) -> None:
    path = drive.parent / "calib_cam_to_cam.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("S_rect_02")]
    path.write_text("\n".join(lines if stated is None else [*lines, f"S_rect_02: {stated}"]) + "\n")
    _resize(drive, lambda image: image.crop((0, 8, image.width, image.height)))
    log = open_log(f"kitti:{drive}")
    lens = log.cameras[0].lens
    assert (lens.width_px, lens.height_px) == (FAKE.width_px, FAKE.height_px - 8)
    assert log.findings() == ()


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no drive of KITTI beside the checkout ({REAL})")
def test_a_real_drive_has_images_of_the_stated_size() -> None:
    log = open_log(f"kitti:{REAL}")
    assert {name: log._stated_sizes[name] for name in ("image_02", "image_03")} == {
        camera.name: (1242, 375) for camera in log.cameras
    }
    assert {(camera.lens.width_px, camera.lens.height_px) for camera in log.cameras} == {(1242, 375)}


def test_an_unknown_option(written: Path) -> None:
    with pytest.raises(ConfigError, match="no option 'label'"):
        open_log(f"kitti:{written / DRIVE}?label=x")


def _remove(name: str):
    return lambda drive: (drive / name).unlink() if (drive / name).is_file() else shutil.rmtree(drive / name)


def _write(name: str, text: str):
    return lambda drive: (drive / name).write_text(text)


BROKEN = {
    "no calibration": (_remove("../calib_velo_to_cam.txt"), "lacks a file", "calib_velo_to_cam"),
    "half a calibration": (_write("../calib_imu_to_velo.txt", "R: 1 0 0"), "R has 3 numbers", "calib_imu_to_velo"),
    "no projection": (_write("../calib_cam_to_cam.txt", "x: 1"), "lacks R_rect_00", "calib_cam_to_cam"),
    "no poses": (_remove("oxts"), "no oxts", "0001_sync"),
    "one pose": (
        lambda drive: [path.unlink() for path in sorted((drive / "oxts/data").iterdir())[1:]],
        "two are needed",
        "oxts",
    ),
    "a pose of words": (_write("oxts/data/0000000003.txt", "a b c d e f"), "could not convert", "0000000003.txt"),
    "an infinite pose": (_write("oxts/data/0000000003.txt", "inf 8 1 0 0 0"), "finite", "0000000003.txt"),
    "no images": (_remove("image_02"), "no images", "0001_sync"),
    "times of words": (_write("image_02/timestamps.txt", "yesterday\n" * 6), "no time", "timestamps.txt"),
    "a thirteenth month": (_write("oxts/timestamps.txt", "2011-13-01 00:00:00.0\n" * 6), "no time", "timestamps.txt"),
    "times that stand": (
        _write("velodyne_points/timestamps.txt", "2011-09-26 13:08:24.9\n" * 6),
        "do not increase",
        "timestamps.txt",
    ),
    "sweeps of text": (
        lambda drive: [path.rename(path.with_suffix(".txt")) for path in (drive / "velodyne_points/data").iterdir()],
        "6 sweeps are text, as in an unsynced drive",
        "0000000000.txt",
    ),
    "few times": (_write("image_02/timestamps.txt", "2011-09-26 13:08:24.9\n"), "1 times for 6", "timestamps.txt"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_drive_is_an_error_that_names_the_file(drive: Path, name: str) -> None:
    break_it, problem, file = BROKEN[name]
    break_it(drive)
    with pytest.raises(InputError, match=problem) as caught:
        open_log(f"kitti:{drive}")
    assert file in str(caught.value.file)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<boost_serialization/>", "no element tracklets"),
        ("<boost_serialization><tracklets>", "cannot be read"),
        ('<?xml version="1.0" encoding="UTF-9"?><x><tracklets/></x>', "unknown encoding"),
        ("<x><tracklets><item><h>1</h></item></tracklets></x>", "item has no number w"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><x><tracklets/></x>', "declares entities"),
    ],
)
def test_broken_tracklets(drive: Path, text: str, problem: str) -> None:
    (drive / "tracklet_labels.xml").write_text(text)
    with pytest.raises(InputError, match=problem) as caught:
        open_log(f"kitti:{drive}").tracks()
    assert caught.value.file is not None


def test_a_cut_sweep(drive: Path) -> None:
    path = drive / "velodyne_points/data/0000000001.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match="points of 16") as caught:
        open_log(f"kitti:{drive}").sweep(1)
    assert caught.value.frame == 1


def test_a_sweep_that_is_a_link_to_nothing(drive: Path) -> None:
    path = drive / "velodyne_points/data/0000000001.bin"
    path.unlink()
    path.symlink_to(drive / "unmounted.bin")
    with pytest.raises(InputError, match="lacks a file") as caught:
        open_log(f"kitti:{drive}").sweep(1)
    assert caught.value.file == str(path) or caught.value.file == path


def test_points_that_are_not_finite_are_left_out(drive: Path) -> None:
    path = drive / "velodyne_points/data/0000000001.bin"
    rows = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4).copy()
    rows[3, 1] = np.nan
    path.write_bytes(rows.tobytes())
    log = open_log(f"kitti:{drive}")
    assert len(log.sweep(1).points_world) == len(rows) - 1
    assert "1 points of sweep 1" in "".join(finding.message for finding in log.findings())


def test_a_missing_sweep_without_a_time_keeps_its_frame(drive: Path) -> None:
    expected = [open_log(f"kitti:{drive}").frame_timestamp_s(frame) for frame in range(FAKE.frame_count)]
    path = drive / "velodyne_points/timestamps.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], "", *lines[3:]]) + "\n")
    (drive / "velodyne_points/data/0000000002.bin").unlink()

    log = open_log(f"kitti:{drive}")
    found = [log.frame_timestamp_s(frame) for frame in range(log.frame_count)]
    assert found == pytest.approx(expected, abs=1e-6)
    assert log.sweep(2) is None
    assert log.sweep(3) is not None


def test_a_drive_without_boxes_says_so(drive: Path) -> None:
    (drive / "tracklet_labels.xml").unlink()
    log = open_log(f"kitti:{drive}")
    assert log.tracks() == ()
    assert [finding.word for finding in log.findings()] == ["no_labels"]


def test_files_of_other_folders_are_no_sweeps_images_or_poses(drive: Path) -> None:
    expected = open_log(f"kitti:{drive}").sweep(0).points_world
    for folder, suffix in (
        ("velodyne_points", "txt"),
        ("velodyne_points", "png"),
        ("image_02", "txt"),
        ("oxts", "bin"),
    ):
        (drive / folder / f"data/0000000000.{suffix}").write_bytes(b"0 8 1 0 0 0 0 00")
    log = open_log(f"kitti:{drive}")
    np.testing.assert_array_equal(log.sweep(0).points_world, expected)
    assert log.image_bytes("image_02", 0) == FAKE.image_bytes("front", 0)


def test_of_two_boxes_of_one_id_the_first_counts(drive: Path, tmp_path: Path) -> None:
    path = tmp_path / "kitti/labels.txt"
    expected = open_log(f"kitti:{drive}?labels={path}").tracks()
    words = path.read_text().splitlines()[1].split()
    words[13] = "99.0"
    path.write_text(path.read_text() + " ".join(words) + "\n")
    log = open_log(f"kitti:{drive}?labels={path}")
    np.testing.assert_array_equal(log.tracks()[0].world_SE3_box, expected[0].world_SE3_box)
    (found,) = [finding for finding in log.findings() if finding.word == "repeated_box_id"]
    assert found.frames == (int(words[0]),) and found.numbers == {"boxes": 1}


def test_every_file_that_is_read_counts(drive: Path) -> None:
    digest = open_log(f"kitti:{drive}").digest()
    for path in sorted(path for path in drive.parent.rglob("*") if path.is_file()):
        data = path.read_bytes()
        path.write_bytes(data + b"\n")
        assert open_log(f"kitti:{drive}").digest() != digest, path
        path.write_bytes(data)
