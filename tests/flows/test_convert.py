"""``genre convert``: any log in the layout of GenRe or of PandaSet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from tests.fakes import FakeLog
from tests.logs.nuscenes_folder import write_nuscenes
from tests.logs.waymo_folder import change_column, write_waymo


@pytest.fixture
def uri(tmp_path: Path) -> str:
    fake = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=60, lidar_rings=8)
    return f"pandaset:{write_pandaset(fake, tmp_path / '007')}"


@pytest.mark.parametrize("layout", ["genre", "pandaset"])
def test_convert(uri: str, layout: str, tmp_path: Path) -> None:
    target = f"{layout}:{tmp_path / 'out'}"
    done = CliRunner().invoke(app, ["convert", uri, target, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    record = json.loads(done.stdout)
    assert (record["written"], record["frames"], record["cameras"], record["tracks"]) == (target, 3, 1, 2)
    assert record["center_ahead_m"] == 0.0
    assert open_log(target).image_bytes("front", 2) == open_log(uri).image_bytes("front", 2)


@pytest.mark.parametrize("target", ["kitti:out", "out", "genre:"])
def test_a_layout_that_cannot_be_written(uri: str, target: str) -> None:
    with pytest.raises(ConfigError, match="names no layout"):
        CliRunner().invoke(app, ["convert", uri, target], catch_exceptions=False)


def test_a_copy_says_how_its_middle_is_stated(tmp_path: Path) -> None:
    fake = FakeLog(frame_count=3, camera_names=("front",), lidar_azimuths=60, lidar_rings=8)
    uri = f"nuscenes:{write_nuscenes(fake, tmp_path / 'data')}"
    done = CliRunner().invoke(app, ["convert", uri, f"genre:{tmp_path / 'out'}"], catch_exceptions=False)
    assert "--set simulate.center_ahead_m=1.3" in done.stdout
    done = CliRunner().invoke(app, ["convert", uri, f"genre:{tmp_path / 'again'}", "--json"], catch_exceptions=False)
    assert json.loads(done.stdout)["center_ahead_m"] == 1.3


def test_a_folder_that_holds_something(uri: str, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something already"):
        CliRunner().invoke(app, ["convert", uri, f"genre:{tmp_path / 'out'}"], catch_exceptions=False)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("layout", ["nuscenes", "waymo"])
def test_other_layouts_are_the_same_log_afterwards(layout: str, tmp_path: Path) -> None:
    fake = FakeLog(frame_count=3, camera_names=("front", "left"), lidar_azimuths=60, lidar_rings=8)
    fake = fake.with_(missing_images=frozenset({("left", 1)}), missing_sweeps=frozenset({2}))
    write = {"nuscenes": write_nuscenes, "waymo": write_waymo}[layout]
    uri = f"{layout}:{write(fake, tmp_path / 'data')}"
    if layout == "waymo":
        change_column(tmp_path / "data", "camera_calibration", "intrinsic.k1", [-0.1, 0.0])
    target = f"genre:{tmp_path / 'out'}"
    assert CliRunner().invoke(app, ["convert", uri, target], catch_exceptions=False).exit_code == 0
    source, found = open_log(uri), open_log(target)
    assert found.cameras == source.cameras
    for frame in range(3):
        assert found.frame_timestamp_s(frame) == source.frame_timestamp_s(frame)
        np.testing.assert_allclose(found.world_SE3_lidar(frame), source.world_SE3_lidar(frame), atol=1e-12)
        for camera in source.cameras:
            assert found.image_bytes(camera.name, frame) == source.image_bytes(camera.name, frame)
            pose = source.world_SE3_camera(camera.name, frame)
            np.testing.assert_allclose(found.world_SE3_camera(camera.name, frame), pose, atol=1e-12)
        expected, sweep = source.sweep(frame), found.sweep(frame)
        assert (expected is None) == (sweep is None) == (frame == 2)
        if expected is not None and sweep is not None:
            np.testing.assert_array_equal(sweep.points_world, expected.points_world)
            np.testing.assert_array_equal(sweep.intensity, expected.intensity)
            assert expected.sensor_world is not None and sweep.sensor_world is not None
            np.testing.assert_array_equal(sweep.sensor_world, expected.sensor_world)
    assert {track.track_id: track.label for track in found.tracks()} == {t.track_id: t.label for t in source.tracks()}
