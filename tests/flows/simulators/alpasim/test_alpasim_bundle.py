"""The scene bundle, read as AlpaSim reads it, and compared with what the service says."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from flows.exchange.export_request import ExportRequest
from flows.exchange.export_scenes import export_scenes
from flows.simulators.alpasim.bundle import write_alpasim_bundle
from flows.simulators.alpasim.local_frame import describe_ego_box, read_local_frame
from flows.simulators.alpasim.wire_poses import read_pose
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.scene_folder import find_changes, read_document, read_scene_folder
from genre_tasks.logs import vehicle_center
from genre_tasks.logs.vehicle_center import REAR_AXLE_TO_CENTER_M
from tests.flows.simulators.alpasim.wire_client import ServedRun, WireClient


@pytest.fixture(scope="module")
def bundle(served: ServedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bundle") / "scene.usdz"
    report = write_alpasim_bundle(served.store, served.run, out)
    assert report["scene_id"] == served.run
    assert report["actors"] == 7
    assert any("lane map" in loss for loss in report["losses"])
    return out


def load(bundle: Path, name: str) -> Any:
    with zipfile.ZipFile(bundle) as archive:
        text = archive.read(name).decode()
    return yaml.safe_load(text) if name.endswith(".yaml") else json.loads(text)


def test_the_rear_axle_is_behind_the_middle_that_the_log_states(
    served: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert served.frame.ego_SE3_rig[0, 3] == -REAR_AXLE_TO_CENTER_M
    monkeypatch.setitem(vehicle_center._CENTER_AHEAD_M, "synthetic", 1.3)
    frame = read_local_frame(served.renderer.scenes)
    assert frame.ego_SE3_rig[0, 3] == pytest.approx(1.3 - REAR_AXLE_TO_CENTER_M)
    # The box's middle is where the log says.
    assert (frame.ego_SE3_rig @ [*describe_ego_box()["centroid"], 1.0])[0] == pytest.approx(1.3)


def test_the_middle_may_be_a_setting_of_the_run(served: ServedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = served.renderer.scenes
    monkeypatch.setitem(scenes.record["config"]["simulate"], "center_ahead_m", 1.0)
    assert read_local_frame(scenes).ego_SE3_rig[0, 3] == pytest.approx(1.0 - REAR_AXLE_TO_CENTER_M)


def test_a_bundle_is_a_plain_zip_of_known_files(bundle: Path) -> None:
    with zipfile.ZipFile(bundle) as archive:
        assert archive.testzip() is None
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        assert archive.namelist() == [
            "metadata.yaml",
            "rig_trajectories.json",
            "sequence_tracks.json",
            "mesh_ground.ply",
            "mesh.ply",
        ]


def test_metadata_has_all_that_is_read(bundle: Path, client: WireClient) -> None:
    metadata = load(bundle, "metadata.yaml")
    assert metadata["scene_id"] == client.scene_id
    assert {type(metadata[name]) for name in ("version_string", "training_date", "dataset_hash", "uuid")} == {str}
    assert metadata["is_resumable"] is False
    assert metadata["sensors"] == {"camera_ids": [c.logical_id for c in client.cameras], "lidar_ids": []}
    assert set(metadata["logger"]) == {"name", "run_id", "run_url"}
    assert metadata["time_range"]["end"] - metadata["time_range"]["start"] == pytest.approx(1.1)
    assert metadata["training_step_outputs"] == {}


def test_the_rig_is_that_of_the_service(bundle: Path, client: WireClient) -> None:
    rig = load(bundle, "rig_trajectories.json")
    assert rig["world_to_nre"]["matrix"] == np.eye(4).tolist()
    assert np.array(rig["T_world_base"]).shape == (4, 4)
    (trajectory,) = rig["rig_trajectories"]
    assert trajectory["T_rig_world_timestamps_us"] == [pose.timestamp_us for pose in client.path]
    expected = np.stack([read_pose(pose.pose, "the rig") for pose in client.path])
    assert np.array(trajectory["T_rig_worlds"]) == pytest.approx(expected, abs=1e-5)
    calibrations = rig["camera_calibrations"]
    assert [entry["logical_sensor_name"] for entry in calibrations.values()] == [c.logical_id for c in client.cameras]
    for entry, camera in zip(calibrations.values(), client.cameras, strict=True):
        assert np.array(entry["T_sensor_rig"]) == pytest.approx(read_pose(camera.rig_to_camera, "it"), abs=1e-5)
        lens = entry["camera_model"]["parameters"]
        assert lens["focal_length"][0] == camera.intrinsics.opencv_pinhole_param.focal_length_x
    assert trajectory["rig_bbox"]["rot"] == [0.0, 0.0, 0.0]


def test_frame_times_are_windows_within_the_path(bundle: Path) -> None:
    rig = load(bundle, "rig_trajectories.json")
    (trajectory,) = rig["rig_trajectories"]
    times = trajectory["T_rig_world_timestamps_us"]
    assert set(trajectory["cameras_frame_timestamps_us"]) == set(rig["camera_calibrations"])
    for windows in trajectory["cameras_frame_timestamps_us"].values():
        assert len(windows) >= len(times) - 2
        flat = [value for window in windows for value in window]
        assert all(type(value) is int for value in flat)
        assert all(start < end for start, end in windows)
        assert times[0] <= flat[0] and flat[-1] <= times[-1]


def test_tracks_are_the_moving_actors(bundle: Path, served: ServedRun) -> None:
    (sequence,) = load(bundle, "sequence_tracks.json").values()
    data = sequence["tracks_data"]
    actors = served.renderer.actors()
    assert data["tracks_id"] == [actor.track_id for actor in actors]
    assert data["tracks_label_class"] == [actor.label for actor in actors]
    assert data["tracks_flags"] == [["CONTROLLABLE"]] * len(actors)
    assert sequence["cuboidtracks_data"]["cuboids_dims"] == [list(actor.size_m) for actor in actors]
    for actor, times, rows in zip(actors, data["tracks_timestamps_us"], data["tracks_poses"], strict=True):
        assert times == [round(time_s * 1e6) for time_s in actor.times_s]
        poses = np.array(rows)
        expected = served.frame.to_local(actor.world_SE3_box)
        assert poses[:, :3] == pytest.approx(expected[:, :3, 3])
        # x, y, z, w: against the order on the wire.
        assert Rotation.from_quat(poses[:, 3:]).as_matrix() == pytest.approx(expected[:, :3, :3])


def test_the_ground_carries_the_path(bundle: Path, client: WireClient) -> None:
    with zipfile.ZipFile(bundle) as archive:
        ply = PlyData.read(io.BytesIO(archive.read("mesh_ground.ply")))
        assert archive.read("mesh.ply") == archive.read("mesh_ground.ply")
    vertices = np.stack([ply["vertex"][name] for name in "xyz"], 1).astype(np.float64)
    faces = np.stack(ply["face"]["vertex_indices"])
    assert faces.shape[1] == 3
    assert set(np.unique(faces)) == set(range(len(vertices)))
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    assert (np.cross(edges[:, 0], edges[:, 1])[:, 2] > 0).all()
    for pose in client.path:
        position = np.array([pose.pose.vec.x, pose.pose.vec.y, pose.pose.vec.z])
        nearest = np.linalg.norm(vertices[:, :2] - position[:2], axis=1).argsort()[:4]
        assert vertices[nearest, 2].mean() == pytest.approx(position[2], abs=0.15)


def test_the_ground_reaches_under_all_traffic(bundle: Path) -> None:
    with zipfile.ZipFile(bundle) as archive:
        ply = PlyData.read(io.BytesIO(archive.read("mesh_ground.ply")))
    vertices = np.stack([ply["vertex"][name] for name in "xy"], 1).astype(np.float64)
    (sequence,) = load(bundle, "sequence_tracks.json").values()
    for rows in sequence["tracks_data"]["tracks_poses"]:
        for x, y, *_ in rows:
            assert np.linalg.norm(vertices - (x, y), axis=1).min() < 1.0


def test_the_same_run_gives_the_same_bytes(bundle: Path, served: ServedRun, tmp_path: Path) -> None:
    again = tmp_path / "deep" / "again.usdz"
    write_alpasim_bundle(served.store, served.run, again)
    assert again.read_bytes() == bundle.read_bytes()


def test_an_unknown_run_writes_nothing(served: ServedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        write_alpasim_bundle(served.store, "ffff", tmp_path / "scene.usdz")
    assert not list(tmp_path.iterdir())


def test_genre_export_writes_the_bundle(bundle: Path, served: ServedRun, tmp_path: Path) -> None:
    out = tmp_path / "exported"
    record = export_scenes(ExportRequest(served.store, served.run[:6], "alpasim", out))
    assert record["files"] == [f"{served.run}.usdz"]
    assert (out / record["files"][0]).read_bytes() == bundle.read_bytes()
    document = read_document(out)
    assert [entry.chunk for entry in document.chunks] == [0, 1]
    assert any("genre serve" in loss for loss in document.losses)
    assert find_changes(out) == ()
    with pytest.raises(InputError, match="format alpasim, which holds no Gaussians"):
        read_scene_folder(out)


@pytest.mark.parametrize("part", [{"frame": 2}, {"all_frames": True}, {"per_actor": True}, {"chunks": (0,)}])
def test_a_bundle_is_of_a_whole_run(served: ServedRun, tmp_path: Path, part: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="whole run"):
        export_scenes(ExportRequest(served.store, served.run, "alpasim", tmp_path / "part", **part))
    assert not list(tmp_path.iterdir())
