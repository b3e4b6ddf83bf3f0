"""The PandaSet reader on small folders: what it converts, what it survives, and what it names when it cannot."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.file_reading import convert_to_seconds
from genre_tasks.logs.pandaset.layout import parse_pose, to_flu_axes, to_panda_axes
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.reader import PandaSetLog, open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from tests.logs.pandaset_folder import FRAMES, cuboids, edit_json, edit_table, small_log, write_table


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pandaset(small_log(), tmp_path_factory.mktemp("source") / "002")


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    shutil.copytree(written, tmp_path / "002")
    return tmp_path / "002"


def opened(folder: Path) -> PandaSetLog:
    return open_pandaset(str(folder))


class TestConversions:
    def test_ego_axes_turn(self) -> None:
        """PandaSet's y is forward and its x is right."""
        ours = to_flu_axes(np.eye(4))
        np.testing.assert_array_equal(ours[:3, 0], [0, 1, 0])
        np.testing.assert_array_equal(ours[:3, 1], [-1, 0, 0])
        np.testing.assert_array_equal(ours[:3, 2], [0, 0, 1])
        np.testing.assert_array_equal(to_panda_axes(ours), np.eye(4))

    def test_quaternion_order(self) -> None:
        """w first: a quarter turn about z takes x to y; the scale of the quaternion does not matter."""
        pose = {"position": {"x": 1, "y": 2, "z": 3}, "heading": {"w": 3.0, "x": 0, "y": 0, "z": 3.0}}
        matrix = parse_pose(pose, file=Path("poses.json"), log="l", frame=0)
        np.testing.assert_allclose(matrix[:3, 0], [0, 1, 0], atol=1e-15)
        np.testing.assert_array_equal(matrix[:3, 3], [1, 2, 3])

    @pytest.mark.parametrize("per_second", [1, 1e3, 1e6, 1e9])
    def test_units_of_time(self, per_second: float) -> None:
        times = np.array([1557539959.250697, 1557539959.350659])
        np.testing.assert_allclose(convert_to_seconds(times * per_second), times, rtol=0, atol=1e-6)

    def test_relative_times_are_seconds(self) -> None:
        np.testing.assert_array_equal(convert_to_seconds(np.array([0.0, 0.1, 1000.0])), [0.0, 0.1, 1000.0])
        assert np.isnan(convert_to_seconds(np.array([np.nan, 1.0]))[0])

    def test_principal_point_counts_from_the_corner(self, folder: Path) -> None:
        path = folder / "camera/front/intrinsics.json"
        path.write_text(json.dumps({"fx": 20.0, "fy": 21.0, "cx": 23.5, "cy": 15.5}))
        camera = opened(folder).cameras[0]
        assert (camera.lens.cx_px, camera.lens.cy_px) == (24.0, 16.0)
        assert (camera.lens.width_px, camera.lens.height_px) == (48, 32)
        assert camera.lens.distortion == () and camera.readout_s == 0.0

    def test_rig_order(self, folder: Path) -> None:
        for name in ("back_camera", "front_camera", "left_camera"):
            shutil.copytree(folder / "camera/front", folder / "camera" / name)
        assert [c.name for c in opened(folder).cameras] == [
            "front_camera",
            "left_camera",
            "back_camera",
            "front",
            "left",
        ]


class TestOpening:
    def test_no_such_folder(self, tmp_path: Path) -> None:
        with pytest.raises(InputError) as caught:
            opened(tmp_path / "003")
        assert caught.value.file == str(tmp_path / "003")

    def test_parent_folder_names_its_sequences(self, folder: Path) -> None:
        with pytest.raises(InputError, match=r"lidar/poses\.json.*Sequences in it: 002"):
            opened(folder.parent)

    @pytest.mark.parametrize("content", ["[1, 2", "{}", "[]", "\udcff"])
    def test_broken_json(self, folder: Path, content: str) -> None:
        (folder / "lidar/poses.json").write_bytes(content.encode(errors="surrogateescape"))
        with pytest.raises(InputError) as caught:
            opened(folder)
        assert caught.value.file == str(folder / "lidar/poses.json")

    def test_lists_of_different_lengths(self, folder: Path) -> None:
        edit_json(folder / "lidar/timestamps.json", lambda times: times[:-1])
        with pytest.raises(InputError, match=f"3 entries.*{FRAMES} frames"):
            opened(folder)

    def test_camera_lists_of_different_lengths(self, folder: Path) -> None:
        edit_json(folder / "camera/left/poses.json", lambda poses: poses[:-1])
        with pytest.raises(InputError, match=r"camera/left/poses\.json"):
            opened(folder).world_SE3_camera("left", 0)

    def test_one_camera(self, folder: Path) -> None:
        shutil.rmtree(folder / "camera/left")
        assert [c.name for c in opened(folder).cameras] == ["front"]

    def test_camera_without_images_is_left_out_and_reported(self, folder: Path) -> None:
        for path in (folder / "camera/left").glob("*.png"):
            path.unlink()
        log = opened(folder)
        assert [c.name for c in log.cameras] == ["front"]
        assert [f.word for f in log.findings()] == ["camera_without_images"]

    @pytest.mark.parametrize("lens", [{"fx": 1.0}, {"fx": float("nan"), "fy": 1, "cx": 1, "cy": 1}, [1], "text"])
    def test_bad_intrinsics(self, folder: Path, lens: Any) -> None:
        path = folder / "camera/left/intrinsics.json"
        path.write_text(json.dumps(lens))
        with pytest.raises(InputError) as caught:
            _ = opened(folder).cameras
        assert (caught.value.camera, caught.value.file) == ("left", str(path))


class TestPoses:
    @pytest.mark.parametrize(
        "damage",
        [
            lambda pose: pose["position"].update(x=float("nan")),
            lambda pose: pose["heading"].update(w=float("inf")),
            lambda pose: pose["heading"].update(w=0, x=0, y=0, z=0),
            lambda pose: pose["heading"].pop("w"),
            lambda pose: pose.pop("position"),
        ],
    )
    def test_bad_pose_names_file_camera_and_frame(self, folder: Path, damage: Callable[[Any], Any]) -> None:
        for path in (folder / "camera/left/poses.json", folder / "lidar/poses.json"):
            edit_json(path, lambda poses: damage(poses[2]) and None)
        log = opened(folder)
        with pytest.raises(InputError) as caught:
            log.world_SE3_camera("left", 2)
        assert (caught.value.camera, caught.value.frame) == ("left", 2)
        assert caught.value.file == str(folder / "camera/left/poses.json")
        with pytest.raises(InputError) as caught:
            log.world_SE3_lidar(2)
        assert (caught.value.frame, caught.value.file) == (2, str(folder / "lidar/poses.json"))
        assert np.isfinite(log.world_SE3_camera("left", 1)).all()


class TestTime:
    def test_unordered_and_duplicated_times_keep_the_order_of_the_file(self, folder: Path) -> None:
        edit_json(folder / "lidar/timestamps.json", lambda _: [5.0, 5.0, 4.9, 5.1])
        log = opened(folder)
        assert [log.frame_timestamp_s(f) for f in range(4)] == [5.0, 5.0, 4.9, 5.1]

    def test_microseconds(self, folder: Path) -> None:
        edit_json(folder / "lidar/timestamps.json", lambda _: [1557539959300518 + 100000 * k for k in range(4)])
        log = opened(folder)
        assert log.frame_timestamp_s(1) == pytest.approx(1557539959.400518, abs=1e-6)

    def test_microseconds_in_a_sweep(self, folder: Path) -> None:
        path = folder / "lidar/01.pkl.gz"
        rows = read_table(path).row_count
        edit_table(path, t=np.full(rows, 1557539959300518, dtype=np.int64))
        sweep = opened(folder).sweep(1)
        assert sweep is not None
        np.testing.assert_allclose(sweep.timestamps_s, 1557539959.300518, atol=1e-6)


class TestSweeps:
    def test_only_the_spinning_sensor(self, folder: Path) -> None:
        path = folder / "lidar/01.pkl.gz"
        rows = read_table(path).row_count
        edit_table(path, d=np.arange(rows) % 2)
        sweep = opened(folder).sweep(1)
        assert sweep is not None
        np.testing.assert_array_equal(sweep.points_world[:, 0], read_table(path).columns["x"][::2])

    def test_without_a_sensor_column(self, folder: Path) -> None:
        path = folder / "lidar/01.pkl.gz"
        edit_table(path, d=None)
        sweep = opened(folder).sweep(1)
        assert sweep is not None and len(sweep.points_world) == read_table(path).row_count

    def test_points_that_are_not_finite_are_left_out_and_reported(self, folder: Path) -> None:
        path = folder / "lidar/01.pkl.gz"
        x = read_table(path).columns["x"].copy()
        x[[0, 5]] = np.nan, np.inf
        edit_table(path, x=x)
        log = opened(folder)
        sweep = log.sweep(1)
        assert sweep is not None and len(sweep.points_world) == len(x) - 2
        assert np.isfinite(sweep.points_world).all()
        assert [f.word for f in log.findings()] == ["invalid_points"]

    @pytest.mark.parametrize("damage", ["truncated", "text", "empty", "hostile", "no column", "text column"])
    def test_unreadable_names_file_and_frame(self, folder: Path, damage: str) -> None:
        path = folder / "lidar/01.pkl.gz"
        table = read_table(path)
        data = path.read_bytes()
        if damage == "no column":
            edit_table(path, z=None)
        elif damage == "text column":
            edit_table(path, z=np.array(["a"] * table.row_count, dtype=object))
        else:
            made = {"truncated": data[: len(data) // 2], "text": b"hello", "empty": b""}
            path.write_bytes(made[damage] if damage in made else gzip.compress(pickle.dumps(os.system)))
        log = opened(folder)
        with pytest.raises(InputError) as caught:
            log.sweep(1)
        assert (caught.value.file, caught.value.frame, caught.value.log) == (str(path), 1, log.uri)
        assert caught.value.remedy
        assert log.sweep(2) is not None

    def test_no_sweeps_at_all(self, folder: Path) -> None:
        for path in (folder / "lidar").glob("*.gz"):
            path.unlink()
        assert all(opened(folder).sweep(frame) is None for frame in range(FRAMES))


class TestTracks:
    def _tracks(self, folder: Path, *tables: dict[str, Any]) -> PandaSetLog:
        shutil.rmtree(folder / "annotations")
        for frame, table in enumerate(tables):
            write_table(folder / f"annotations/cuboids/{frame:02d}.pkl.gz", table)
        return opened(folder)

    def test_no_cuboids(self, folder: Path) -> None:
        shutil.rmtree(folder / "annotations")
        assert opened(folder).tracks() == ()

    def test_box_axes(self, folder: Path) -> None:
        """The length lies along the local y of PandaSet; at yaw 0 our x is the world's y."""
        row = {"position.x": 5.0, "position.y": 6.0, "position.z": 0.7}
        (track,) = self._tracks(folder, cuboids(row)).tracks()
        np.testing.assert_allclose(track.world_SE3_box[0][:3, 0], [0, 1, 0], atol=1e-15)
        np.testing.assert_array_equal(track.world_SE3_box[0][:3, 3], [5.0, 6.0, 0.7])
        assert track.size_m == (4.0, 2.0, 1.5)

    def test_boxes_that_are_not_finite_are_left_out_and_reported(self, folder: Path) -> None:
        good, bad = {"uuid": "b"}, {"uuid": "b", "position.y": float("nan")}
        only_bad = {"uuid": "c", "yaw": float("inf")}
        flat = {"uuid": "d", "dimensions.z": 0.0}
        log = self._tracks(folder, cuboids(good, only_bad), cuboids(bad, flat), cuboids(good), cuboids(good))
        (track,) = log.tracks()
        assert track.track_id == "b" and track.frames.tolist() == [0, 2, 3]
        assert [f.word for f in log.findings()] == ["invalid_box"] * 3

    def test_an_object_seen_by_both_sensors_is_one(self, folder: Path) -> None:
        """The spinning sensor's box counts; the other sensor's fills its gaps."""
        spin = {"uuid": "s" * 36, "cuboids.sensor_id": 0, "cuboids.sibling_id": "f" * 36, "position.x": 1.0}
        front = {"uuid": "f" * 36, "cuboids.sensor_id": 1, "cuboids.sibling_id": "s" * 36, "position.x": 2.0}
        (track,) = self._tracks(folder, cuboids(front, spin), cuboids(front), cuboids(spin)).tracks()
        assert track.track_id == "s" * 36
        assert track.frames.tolist() == [0, 1, 2]
        assert track.world_SE3_box[:, 0, 3].tolist() == [1.0, 2.0, 1.0]

    @pytest.mark.parametrize(
        ("of_spin", "of_front"), [("-", "s" * 36), ("f" * 34, "-"), ("s" * 36, "s" * 36), ("f" * 36, "unknown")]
    )
    def test_damaged_sibling_links(self, folder: Path, of_spin: str, of_front: str) -> None:
        """One-sided, cut off, pointing at itself, pointing nowhere: all of them are in real files."""
        spin = {"uuid": "s" * 36, "cuboids.sensor_id": 0, "cuboids.sibling_id": of_spin}
        front = {"uuid": "f" * 36, "cuboids.sensor_id": 1, "cuboids.sibling_id": of_front}
        assert len(self._tracks(folder, cuboids(front, spin)).tracks()) == 1

    def test_unlinked_objects_stay_two(self, folder: Path) -> None:
        one, two = {"uuid": "a", "cuboids.sensor_id": 0}, {"uuid": "b", "cuboids.sensor_id": 1}
        assert len(self._tracks(folder, cuboids(one, two)).tracks()) == 2

    @pytest.mark.parametrize(
        ("row", "moving"),
        [
            ({"attributes.object_motion": "Moving"}, True),
            ({"attributes.object_motion": "Stopped", "stationary": False}, False),
            ({"attributes.object_motion": float("nan"), "stationary": False}, True),
            ({"attributes.object_motion": float("nan"), "attributes.pedestrian_behavior": "Walking"}, True),
            (
                {
                    "attributes.object_motion": float("nan"),
                    "attributes.pedestrian_behavior": "Standing",
                    "stationary": False,
                },
                False,
            ),
            ({"attributes.object_motion": None}, False),
        ],
    )
    def test_moving(self, folder: Path, row: dict[str, Any], moving: bool) -> None:
        (track,) = self._tracks(folder, cuboids({}), cuboids(row)).tracks()
        (still,) = self._tracks(folder, cuboids({}), cuboids({})).tracks()
        assert track.moving is moving
        assert still.moving is False

    def test_size_is_the_median(self, folder: Path) -> None:
        (track,) = self._tracks(folder, *(cuboids({"dimensions.y": size}) for size in (4.0, 4.1, 9.0))).tracks()
        assert track.size_m[0] == 4.1

    def test_missing_columns(self, folder: Path) -> None:
        table = cuboids({})
        del table["yaw"]
        with pytest.raises(InputError, match="yaw"):
            self._tracks(folder, table).tracks()


class TestDigest:
    @pytest.mark.parametrize(
        "name",
        [
            "lidar/01.pkl.gz",
            "lidar/poses.json",
            "camera/left/02.png",
            "camera/left/intrinsics.json",
            "annotations/cuboids/00.pkl.gz",
        ],
    )
    def test_a_changed_byte_changes_it(self, folder: Path, name: str) -> None:
        before = opened(folder).digest()
        data = (folder / name).read_bytes()
        changed = data.replace(b": 1", b": 2").replace(b": 0", b": 5") if name.endswith("json") else data[:-1] + b"!"
        assert changed != data and len(changed) == len(data)
        (folder / name).write_bytes(changed)
        os.utime(folder / name, ns=(1, 1))
        assert opened(folder).digest() != before

    def test_a_removed_or_renamed_file_changes_it(self, folder: Path) -> None:
        before = opened(folder).digest()
        (folder / "camera/left/02.png").rename(folder / "camera/left/09.png")
        renamed = opened(folder).digest()
        (folder / "camera/left/09.png").unlink()
        assert len({before, renamed, opened(folder).digest()}) == 3

    def test_elsewhere_it_is_the_same(self, folder: Path, written: Path) -> None:
        assert opened(folder).digest() == opened(written).digest()
        (folder / "meta/gps.json").write_text("[]")
        assert opened(folder).digest() == opened(written).digest()
