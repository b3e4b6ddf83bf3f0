"""What sensors of a rollout leave in its folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from flows.simulation.lidar_files import LidarSweeps
from flows.simulation.sensor_images import FlowImages, MaskImages
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.rollout.rig import RigCamera
from storage.codecs.exr import read_channels
from tests.lidar_simulation.spinning_lidar import FlashLog, ego_path
from tests.lidar_simulation.test_simulate_sweep import SpinningLog
from tests.rollout.test_sensor_images import LENS, SETTINGS, actor, build_scene, images_at, rectangle, two_actors

RIG = (RigCamera("front", LENS, np.eye(4)),)
SIZE = (LENS.height_px, LENS.width_px)


def read_png(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        assert image.mode == "I;16"
        return np.asarray(image)


def test_masks_keep_their_numbers_when_scenes_number_actors_anew(tmp_path: Path):
    second = two_actors().actors[1]
    output = MaskImages(tmp_path, RIG, SETTINGS)
    output.write(images_at(two_actors(), 0))
    output.write(images_at(build_scene((second, actor("c", -1.2, 0.0, "bus"))), 1))
    output.close()
    table = json.loads((tmp_path / "labels.json").read_text())
    assert [table["instances"][number]["track_id"] for number in ("1", "2", "3")] == ["a", "b", "c"]
    assert table["classes"] == {"0": "empty", "1": "static", "2": "distant", "3": "car", "4": "van", "5": "bus"}
    before, after = (read_png(tmp_path / f"instances/front/00000{k}.png") for k in (0, 1))
    assert (before[rectangle(-1.2)] == 1).all() and (before[rectangle(1.2)] == 2).all()
    assert (after[rectangle(-1.2)] == 3).all() and (after[rectangle(1.2)] == 2).all()
    assert (read_png(tmp_path / "classes/front/000001.png")[rectangle(-1.2)] == 5).all()


def test_flow_of_a_pose_leads_to_the_next_one(tmp_path: Path):
    output = FlowImages(tmp_path, RIG, SETTINGS)
    for frame in (0, 1):
        output.write(images_at(two_actors(), frame, shift_m=0.2 * frame))
    output.close()
    assert [path.name for path in (tmp_path / "flow/front").iterdir()] == ["000000.exr"]
    flow = read_channels(tmp_path / "flow/front/000000.exr", {"U": np.float32, "V": np.float32}, SIZE)
    assert np.abs(flow["U"][18, 31:33] + 1.2).max() < 0.03
    assert np.isnan(flow["U"]).any()


def test_a_sweep_is_a_table_of_world_points(tmp_path: Path):
    times, poses = ego_path()
    path = EgoPath(times, np.arange(5.0), poses)
    output = LidarSweeps(tmp_path, SpinningLog(), path)
    output.write(images_at(build_scene(()), 1))
    output.close()
    table = pq.read_table(tmp_path / "lidar/000001.parquet").to_pydict()
    assert list(table) == ["x", "y", "z", "intensity", "time_s", "frame", "ring"]
    x, y, z = (np.array(table[name]) for name in "xyz")
    assert len(x) > 1000
    on_ground = np.abs(z) < 0.1
    on_wall = np.abs(np.abs(y) - 8.0) < 0.1
    assert (on_ground | on_wall | (np.abs(x) > 30)).mean() > 0.95
    assert set(table["frame"]) == {1.0}
    assert -0.1 <= min(table["time_s"]) < max(table["time_s"]) <= 0.0
    assert set(table["ring"]) <= set(range(24)) and len(set(table["ring"])) > 15
    assert output.list_warnings() == ()


def test_rays_from_an_assumed_place_are_a_warning(tmp_path: Path):
    times, poses = ego_path()
    path = EgoPath(times, np.arange(5.0), poses)
    (warning,) = LidarSweeps(tmp_path, FlashLog(states_sensor=False), path).list_warnings()
    assert "does not say where its LiDAR is" in warning
    assert LidarSweeps(tmp_path, FlashLog(states_sensor=True), path).list_warnings() == ()
